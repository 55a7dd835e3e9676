"""Meshes of a made-up house, whose every place is known, and of a made city from true depths."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.apps import mesh as meshes
from clsplat.apps.map_grid import ground_resolution
from clsplat.apps.mesh import open_edges, run_mesh
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.mesh.decimate import edges_of
from clsplat.rendering.blend import Blended
from clsplat.scene import Scene, View
from tests.apps.test_map import run_of
from tests.command_line import clsplat_
from tests.data import ground_model as made
from tools.studies.mesh import compared, on_surface, outside, shown_surface, solids_at
from tools.synth.city import distances, geometry_json, lay_out, read_city
from tools.synth.raycast import cast
from tools.synth.survey import observe, survey

VOXEL = 0.2


def house(device):
    scene = made.scene(made.UTM)
    return run_mesh(run_of("house", scene), scene, device, VOXEL)


@pytest.fixture(scope="module")
def whole(item_device):
    return house(item_device)


def test_places_and_colours(whole):
    heights = whole.vertices[:, 2] - made.OFFSET[2]
    roof = heights > made.ROOF / 3
    assert heights.min() > -VOXEL and heights.max() < made.ROOF + VOXEL
    # the rim of a roof without walls is as deep as the truncation
    assert not ((heights > VOXEL) & (heights < made.ROOF - (meshes.TRUNCATION + 1) * VOXEL)).any()
    on = on_surface(whole, 10_000)[:, 2] - made.OFFSET[2]
    assert np.quantile(np.minimum(abs(on), abs(on - made.ROOF)), 0.95) < VOXEL / 20
    sides = whole.vertices[:, :2] - made.OFFSET[:2]
    assert abs(sides[roof]).max() < made.HOUSE + 2 * made.SPACING + VOXEL
    assert abs(sides).max() > made.SIDE - 4 * made.SPACING
    away = abs(sides).max(axis=1)  # the rim has both colours
    for which, colour in ((roof & (away < made.HOUSE - 0.5), made.ROOF_BLUE), (abs(away - 7) < 3, made.GROUND_RED)):
        # by no more than vertices of other colours that are merged with one
        assert which.any() and abs(whole.colours[which] - np.multiply(colour, 255)).max() < 8
    first, second, third = whole.vertices[whole.triangles].transpose(1, 0, 2)
    up = np.cross(second - first, third - first)[:, 2]
    assert -np.minimum(up, 0).sum() < 0.05 * up.sum()
    # flat ground needs few triangles
    assert len(whole.triangles) < 0.2 * (2 * made.SIDE / VOXEL) ** 2 * 2


@pytest.mark.slow
def test_bricks_and_batches_leave_no_cracks(item_device, whole, monkeypatch):
    """In any number of batches the surface is one, and has no open edge between bricks."""
    monkeypatch.setattr(meshes, "BATCH_BYTES", 9 * meshes.brick_bytes(item_device))
    parts = house(item_device)
    assert len(parts.triangles) > len(whole.triangles), "borders of batches stay fine"
    for mesh in (whole, parts):
        edges, counts = edges_of(mesh.triangles)
        sides = mesh.vertices[np.unique(edges[counts == 1])] - made.OFFSET
        ground = sides[sides[:, 2] < 1][:, :2]
        inside = abs(ground).max(axis=1)  # open edges lie at the ends of ground and roof alone
        assert ((inside > made.SIDE - 1) | (inside < made.HOUSE + 1)).all()
        assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    areas = [
        np.linalg.norm(
            np.cross(*(mesh.vertices[mesh.triangles[:, i]] - mesh.vertices[mesh.triangles[:, 0]] for i in (1, 2))),
            axis=1,
        ).sum()
        / 2
        for mesh in (whole, parts)
    ]
    assert areas[0] == pytest.approx(areas[1], rel=0.03)  # small folds count twice
    again = house(item_device)
    assert np.array_equal(again.vertices, parts.vertices)
    assert np.array_equal(again.triangles, parts.triangles)


def test_islands_are_left_out():
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    pieces = meshes.Pieces.joined(
        [
            meshes.Pieces(side * square + (0, 0, z), np.full((4, 3), z), faces, np.zeros(4, bool))
            for side, z in ((30.0, 0), (5.0, 50), (21.0, 90))
        ]
    )
    left = pieces.without_islands()
    assert set(left.vertices[:, 2]) == {0, 90} and len(left.triangles) == 4
    assert np.array_equal(left.vertices[left.triangles][2:, :, 2], np.full((2, 3), 90))


@pytest.fixture(scope="module")
def made_city():
    """A city of one block, and a scene of it without photos."""
    city = lay_out((1, 1), 3)
    cameras = survey(city, 12, 160, 120, 3)
    points, *_ = observe(city, cameras, 3)
    views = tuple(View(f"{number:02d}.jpg", camera, b"") for number, camera in enumerate(cameras))
    return city, Scene("city", views, points, np.zeros((len(points), 3), np.uint8))


def true_depths(city, device):
    """In place of `Views.blended`: the depths of a city's surfaces, and height as colour."""

    def blended(self, camera, percent):
        size = camera.height, camera.width
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        places, solid = cast(city, camera, np.stack([x.ravel(), y.ravel()], axis=1))
        depth = np.where(solid < 0, 0, camera.project(np.nan_to_num(places))[1]).reshape(size)
        image = np.broadcast_to(np.nan_to_num(places[:, 2].reshape(size) / 20), (3, *size))
        return Blended(
            device.upload(np.ascontiguousarray(image)),
            device.upload((solid < 0).reshape(size).astype(float)),
            None,
            device.upload(depth),
        )

    return blended


@pytest.mark.slow
def test_a_made_city_is_within_a_ground_sample_distance(item_device, made_city, monkeypatch):
    city, scene = made_city
    rows = {**made.model().rows}
    run = SimpleNamespace(path="city", finished_model=Gaussians(rows, 0), options=run_of("", scene).options)
    monkeypatch.setattr(meshes.Views, "blended", true_depths(city, item_device))
    mesh = run_mesh(run, scene, item_device)
    assert mesh.voxel == ground_resolution(scene)
    scores = compared(mesh, city, scene, 20_000)
    assert scores["vertices_within_1"] > 0.95 and scores["surface_within_1"] > 0.98, scores
    assert scores["surface_within_0.5"] > 0.9 and scores["complete"] > 0.8, scores
    assert scores["true_surface"] > 0.8 and scores["shared_edges"] < 100, scores
    heights = mesh.colours[:, 0] / 255 * 20
    assert np.median(abs(heights - mesh.vertices[:, 2])) < 2 * mesh.voxel
    assert open_edges(mesh), "the ground ends"


def test_distances_of_a_made_city(made_city, tmp_path):
    city, _ = made_city
    (tmp_path / "geometry.json").write_text(geometry_json(city))
    again = read_city(tmp_path / "geometry.json")
    low, high = again.boxes[0]
    *centre, radius = again.spheres[0]
    points = np.array(
        [
            [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2] + 50],
            [400, 300, -0.5],
            [400, 300, 2],
            [*np.add(centre, (0, 0, radius + 30))],
        ]
    )
    found = distances(again, points)
    assert found[0] <= 50 and np.allclose(found[1:3], [-0.5, 2]) and found[3] <= 30.001
    assert np.array_equal(found, distances(city, points))
    assert -high[2] < distances(again, (low + high)[None] / 2)[0] < -0.3, "inside of a building"
    corner = np.array([high + [0, 0, 3]])
    assert (
        abs(distances(again, corner)[0]) <= 3
        and len(on_surface(SimpleNamespace(vertices=np.eye(3), triangles=np.array([[0, 1, 2]])), 10)) == 10
    )


def test_the_study_names_places(made_city):
    city, scene = made_city
    (low, high), *_ = city.boxes[city.kinds == 0]
    *centre, radius = city.spheres[0]
    middle = (low + high) / 2
    kinds = solids_at(
        city,
        np.array(
            [
                [*middle[:2], high[2] + 0.1],
                [high[0] + 0.1, *middle[1:]],
                np.add(centre, (0, 0, radius)),
                [*(2 * city.extent), 0.1],
            ]
        ),
    )
    assert kinds[1:].tolist() == ["wall", "tree", "rim"] and kinds[0] in ("roof", "small box")
    points = shown_surface(city, [view.camera for view in scene.views], 0.5, 2000)
    assert 500 < len(points) < 2000 and abs(distances(city, points)).max() < 0.1
    assert not len(shown_surface(city, [scene.views[0].camera], 0.5, 2000)), "one camera is not two"
    square = SimpleNamespace(
        vertices=np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), triangles=np.array([[0, 1, 2], [0, 2, 3]])
    )
    found = outside(square, city, np.array([0, 0, 3, -3]), 1.0)
    assert found["at open edges"] == [1, 0.5, 1] and "inner" not in found


def test_the_command(tmp_path, monkeypatch):
    scene = made.scene(made.UTM)
    monkeypatch.setattr(Run, "open", lambda path: run_of(path, scene))
    output = tmp_path / "house.ply"
    words = "mesh", "run", "-o", output, "--voxel", 0.4
    result = clsplat_(*words)
    assert result.exit_code == 0, result.output
    assert "voxels of 0.4 m" in result.output and "EPSG:32633" in result.output
    assert "open edges" in result.output and b"EPSG:32633" in output.read_bytes()[:1000]
    again = clsplat_(*words)
    assert again.exit_code == 2 and "--overwrite" in again.output
    wrong = clsplat_("mesh", "run", "-o", tmp_path / "house.stl")
    assert wrong.exit_code == 2 and ".glb, .ply, .obj" in wrong.output
    assert {path.name for path in tmp_path.iterdir()} == {"house.ply"}


@pytest.mark.parametrize(
    "voxel, says", [(1e-3, "smaller than 4 voxels of 0.001"), (50.0, "agree on no surface in voxels of 50")]
)
def test_voxels_that_do_not_suit(item_device, voxel, says):
    scene = made.scene(None)
    with pytest.raises(InputError, match=says):
        run_mesh(run_of("house", scene), scene, item_device, voxel)
