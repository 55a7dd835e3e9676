"""How true the mesh of a run on a made city is: the distances of its vertices and its surface from
the solids, in ground sample distances.

    python -m tools.studies.mesh RUN [--voxel 0.05]

prints one line of JSON. Parts of the ground that no two photos show have no vertices, so `complete`
counts the sparse points of the scene that have the mesh within two ground sample distances.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import scipy

from clsplat.apps.map_grid import ground_resolution
from clsplat.apps.mesh import open_edges, run_mesh
from clsplat.device import choose_device
from clsplat.evaluation.run import Run
from tools.synth.city import distances, read_city

LIMITS = (0.5, 1.0, 2.0)  # ground sample distances
SAMPLES = 400_000  # of the surface


def on_surface(mesh, count, seed=0):
    """Points float64[count, 3], uniformly on the triangles of a mesh."""
    rng, corners = np.random.default_rng(seed), mesh.vertices[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
                          axis=1)
    chosen = corners[rng.choice(len(area), count, p=area / area.sum())]
    return np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), count), chosen)


def compared(mesh, city, scene, samples=SAMPLES):
    """The scores of a mesh, shares of 1."""
    pixel, surface = ground_resolution(scene), on_surface(mesh, samples)
    errors = {"vertices": distances(city, mesh.vertices), "surface": distances(city, surface)}
    places = scene.offset + scene.unit * scene.points
    near, _ = scipy.spatial.cKDTree(surface).query(places)
    return {"pixel": pixel, "voxel": mesh.voxel, "triangles": len(mesh.triangles),
            "open_edges": open_edges(mesh), "complete": float((near < 2 * pixel).mean()),
            **{f"{name}_within_{limit:g}": float((abs(values) < limit * pixel).mean())
               for name, values in errors.items() for limit in LIMITS}}


def main():
    """Make the mesh of a run, and print its scores."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--voxel", type=float, help="world units")
    parser.add_argument("--device", default="auto", help="as of clsplat")
    given = parser.parse_args()
    run, device = Run.open(given.run), choose_device(given.device)
    scene, begin = run.scene(), time.perf_counter()
    mesh = run_mesh(run, scene, device, given.voxel)
    seconds = time.perf_counter() - begin
    print(json.dumps({"seconds": seconds, **compared(
        mesh, read_city(scene.path / "geometry.json"), scene)}))


if __name__ == "__main__":
    main()
