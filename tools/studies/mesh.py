"""How true the mesh of a run on a made city is: the distances of its vertices and its surface from
the solids, in ground sample distances.

    python -m tools.studies.mesh RUN [--voxel 0.05]

prints one line of JSON. `complete` counts the sparse points of the scene that have the mesh within
two ground sample distances, `true_surface` the places of the solids, shown by two photos, that have
it within one: to leave out what is unsure makes vertices better, these worse. `outside` says where
the vertices lie that are more than one ground sample distance from the solids: the share of all
vertices that are at such a place, the share of these that are outside, and their share of all that
are outside.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import scipy

from clsplat.apps.map_grid import ground_resolution
from clsplat.apps.mesh import open_edges, run_mesh
from clsplat.apps.models import in_original
from clsplat.device import choose_device
from clsplat.evaluation.run import Run
from clsplat.mesh.decimate import edges_of
from tools.synth.city import KINDS, distances, read_city, sample
from tools.synth.raycast import cast

LIMITS = (0.5, 1.0, 2.0)  # ground sample distances
SAMPLES = 400_000  # of the surface
FINE = 3  # samples a pixel along each axis, where true places look for the mesh
TRUE_SAMPLES = 100_000  # of the solids
MARGIN = 2.0  # world units around the built area in which ground counts
HIDDEN = 0.2  # pixels between a place and what a ray meets: it is hidden


def areas(mesh):
    """The areas float64[M] of the triangles of a mesh."""
    first, second, third = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2


def on_surface(mesh, count, seed=0):
    """Points float64[count, 3], uniformly on the triangles of a mesh."""
    rng, corners, area = np.random.default_rng(seed), mesh.vertices[mesh.triangles], areas(mesh)
    chosen = corners[rng.choice(len(area), count, p=area / area.sum())]
    return np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), count), chosen)


def shown_surface(city, cameras, pixel, count=TRUE_SAMPLES, seed=0):
    """Points float64[N, 3], uniformly on what at least two cameras show of the solids."""
    points, shown = sample(city, count, MARGIN, np.random.default_rng(seed)), np.zeros(count, int)
    for camera in cameras:
        places, depths = camera.project(points)
        within = np.flatnonzero(
            (depths > 0) & (places >= 0).all(axis=1) & (places < (camera.width, camera.height)).all(axis=1)
        )
        met, _ = cast(city, camera, places[within])
        shown[within] += np.linalg.norm(met - points[within], axis=1) < HIDDEN * pixel
    return points[shown >= 2]


def solids_at(city, points):
    """The kinds of the solids str[N] next to points [N, 3]; of a building its roof or its walls."""
    nearest, kinds = abs(points[:, 2]), np.full(len(points), "ground", object)
    kinds[(abs(points[:, :2]) > city.extent).any(axis=1)] = "rim"
    for (low, high), kind in zip(city.boxes, city.kinds):
        beyond = np.maximum(low - points, points - high)
        away = abs(np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0))
        here = away < nearest
        nearest[here] = away[here]
        roof = abs(points[here, 2] - high[2]) < abs(beyond[here, :2]).min(axis=1)
        kinds[here] = np.where(roof, "roof", "wall") if KINDS[kind] == "building" else "small box"
    for *centre, radius in city.spheres:
        away = abs(np.linalg.norm(points - centre, axis=1) - radius)
        kinds[away < nearest] = "tree"
        nearest = np.minimum(nearest, away)
    return kinds


def outside(mesh, city, errors, pixel):
    """Where vertices lie that are more than a pixel from the solids: see the module."""
    far, edges, triangles = abs(errors) > pixel, edges_of(mesh.triangles), mesh.triangles
    rim = np.zeros(len(errors), bool)
    rim[edges[0][edges[1] == 1]] = True
    beside = np.zeros(len(errors), bool)
    beside[triangles[rim[triangles].any(axis=1)]] = True
    kinds = solids_at(city, mesh.vertices)
    places = {
        "at open edges": rim,
        "beside open edges": beside & ~rim,
        "inner": ~beside,
        **{kind: kinds == kind for kind in np.unique(kinds)},
    }
    return {
        name: [
            round(float(share), 3) for share in (here.mean(), far[here].mean(), (far & here).sum() / max(1, far.sum()))
        ]
        for name, here in places.items()
        if here.any()
    }


def compared(mesh, city, scene, samples=SAMPLES):
    """The scores of a mesh, shares of 1."""
    pixel, surface = ground_resolution(scene), on_surface(mesh, samples)
    errors = {"vertices": distances(city, mesh.vertices), "surface": distances(city, surface)}
    places = scene.offset + scene.unit * scene.points
    near, _ = scipy.spatial.cKDTree(surface).query(places)
    true = shown_surface(city, in_original(scene), pixel)
    fine = on_surface(mesh, max(samples, int(areas(mesh).sum() * (FINE / pixel) ** 2)))
    reached, _ = scipy.spatial.cKDTree(fine).query(true, distance_upper_bound=pixel)
    return {
        "pixel": pixel,
        "voxel": mesh.voxel,
        "triangles": len(mesh.triangles),
        "open_edges": open_edges(mesh),
        "shared_edges": int((edges_of(mesh.triangles)[1] > 2).sum()),
        "complete": float((near < 2 * pixel).mean()),
        "true_surface": float(np.isfinite(reached).mean()),
        **{
            f"{name}_within_{limit:g}": float((abs(values) < limit * pixel).mean())
            for name, values in errors.items()
            for limit in LIMITS
        },
        "outside": outside(mesh, city, errors["vertices"], pixel),
    }


def main():
    """Make the mesh of a run, and print its scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--voxel", type=float, help="world units")
    parser.add_argument("--device", default="auto", help="as of clsplat")
    given = parser.parse_args()
    run, device = Run.open(given.run), choose_device(given.device)
    scene, begin = run.scene(), time.perf_counter()
    mesh = run_mesh(run, scene, device, given.voxel)
    seconds = time.perf_counter() - begin
    print(json.dumps({"seconds": seconds, **compared(mesh, read_city(scene.path / "geometry.json"), scene)}))


if __name__ == "__main__":
    main()
