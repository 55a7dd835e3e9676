"""The synthetic city: correct ground truth, a model that COLMAP reads, the same bytes again."""

import json

import numpy as np
import pycolmap
import pytest

from clsplat.io.photos.images import read_image
from tools.synth import raycast
from tools.synth.__main__ import main, synthesise
from tools.synth.city import KINDS, City, lay_out, sample
from tools.synth.survey import looking, observe, survey

TINY = {"blocks": (1, 1), "views": 6, "size": (48, 36), "seed": 3}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synth") / "scene"
    synthesise(folder, **TINY)
    return folder


@pytest.fixture(scope="module")
def observed():
    city = lay_out((1, 1), 0)
    cameras = survey(city, 12, 320, 240)
    return city, cameras, *observe(city, cameras)


@pytest.fixture
def solids():
    """A box 4 x 2 x 5 and a unit sphere."""
    return City(
        0,
        (1, 1),
        np.zeros((1, 1), bool),
        np.array([[[0, 0, 0], [4, 2, 5.0]]]),
        np.array([0]),
        np.array([[-5, 0, 3, 1.0]]),
    )


def distance(city, points):
    """The unsigned distance [N] of world points [N, 3] to the nearest true surface.

    The city is one solid, the union of the ground below z = 0, the boxes and the spheres. The
    distance is exact outside it. Inside, it is a lower bound, exact except where solids overlap.
    """
    x, y, z = np.asarray(points, np.float64).T
    signed = z.copy()
    for low, high in city.boxes:
        gaps = (
            np.maximum(low[0] - x, x - high[0]),
            np.maximum(low[1] - y, y - high[1]),
            z - high[2],
        )  # the underside of a box is not a surface
        outside = np.sqrt(sum(np.maximum(gap, 0) ** 2 for gap in gaps))
        signed = np.minimum(signed, outside + np.minimum(np.maximum.reduce(gaps), 0))
    for *centre, radius in city.spheres:
        signed = np.minimum(signed, np.linalg.norm(points - np.array(centre), axis=1) - radius)
    return np.abs(signed)


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_samples_lie_on_surfaces_in_proportion_to_area(solids):
    points = sample(solids, 20000, 0.0, np.random.default_rng(0))
    on_box = (points[:, 2] > 0) & (points[:, 0] > -3)
    on_sphere = points[:, 0] < -3
    assert np.linalg.norm(points[on_sphere & (points[:, 2] > 0)] - (-5, 0, 3), axis=1) == pytest.approx(1)
    assert distance(solids, points[on_box]).max() < 1e-12
    ground, box, sphere = 4 * solids.extent.prod(), 2 * (4 + 2) * 5 + 4 * 2, 4 * np.pi
    total = ground + box + sphere
    assert on_box.mean() == pytest.approx(box / total, rel=0.1)
    assert (points[:, 2] == 0).mean() == pytest.approx(ground / total, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    "position, forward",
    [
        ((3, -16, 21), (0.1, 0.7, -1)),  # from above
        ((2, -11, 2), (-1, -0.2, -0.1)),  # down a street: solids behind, beside and across its plane
        ((9.5, 2, 1.5), (0.1, 1, 0.1)),
    ],
)
def test_culling_does_not_lose_hits(position, forward):
    city = lay_out((2, 2), 1)
    camera = looking(np.array(position, float), np.array(forward, float), np.array([0, 0, 1.0]), 40, 30)
    pixels = np.random.default_rng(0).uniform(0, (40, 30), (2000, 2))
    points, primitive = raycast.cast(city, camera, pixels)
    directions = np.column_stack([(pixels - camera.centre) / camera.focal, np.ones(2000)]) @ camera.rotation
    everywhere = np.tile([[-np.inf, -np.inf], [np.inf, np.inf]], (len(city.bounds), 1, 1))
    met, solid = raycast._nearest(
        city, np.broadcast_to(camera.position, directions.shape), directions, pixels, everywhere
    )
    on = primitive > 0
    assert len(np.unique(primitive)) > 10
    assert (solid[on] == primitive[on]).all()
    # where the ground or the sky is seen, no solid is in front of it
    length = np.where(on, 0, (points - camera.position)[:, 2] / directions[:, 2])
    assert (met[~on] >= length[~on]).all()
    assert distance(city, points[primitive >= 0]).max() < 1e-9


def test_the_box_casts_its_shadow_away_from_the_sun(solids):
    to_sun = raycast.SUN / raycast.SUN[2]  # a step up by one
    below, above = (np.array([2, 1, height]) - height * to_sun for height in (4, 9))
    points = np.array([below, above, [4, 2, 0] - below])  # the last is on the sunny side
    hidden = raycast.shadowed(solids, points, np.tile([0, 0, 1.0], (3, 1)))
    assert hidden.tolist() == [True, False, False]


def test_points_lie_on_the_surface_within_noise(observed):
    city, cameras, points, *_ = observed
    off = distance(city, points)
    pixel = 30 / cameras[0].focal[0]  # world units, at the flying height
    assert 0.05 * pixel < off.mean() < 0.5 * pixel
    assert off.max() < 2.5 * pixel


def test_tracks_reproject_within_noise_and_are_not_hidden(observed):
    city, cameras, points, point, view, pixels = observed
    assert (np.bincount(point, minlength=len(points)) >= 2).all()
    for number, camera in enumerate(cameras):
        rows = view == number
        projected, _ = camera.project(points[point[rows]])
        error = np.linalg.norm(projected - pixels[rows], axis=1)
        assert 0.2 < error.mean() < 0.8 and error.max() < 3.5
        # the camera sees the point there, except where noise moves it past an edge
        met, _ = raycast.cast(city, camera, projected)
        assert (np.linalg.norm(met - points[point[rows]], axis=1) < 1).mean() > 0.93


def test_pycolmap_reads_the_model(scene):
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    cameras = survey(lay_out((1, 1), 3), 6, 48, 36, 3)
    assert (model.num_cameras(), model.num_images()) == (1, 6)
    camera = model.cameras[1]
    assert camera.model.name == "PINHOLE" and (camera.width, camera.height) == (48, 36)
    assert np.allclose(camera.params, [*cameras[0].focal, 24, 18])
    model.update_point_3d_errors()  # by COLMAP, of poses and observations
    assert 0.2 < np.mean([point.error for point in model.points3D.values()]) < 0.8
    for number, ours in enumerate(cameras, 1):
        image = model.images[number]
        assert image.name == f"{number - 1:03d}.jpg"
        assert np.allclose(
            image.cam_from_world().matrix(), np.column_stack([ours.rotation, ours.translation]), atol=1e-9
        )
        pixels = read_image(scene / "images" / image.name)
        assert pixels.shape == (36, 48, 3) and pixels.std() > 20


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(scene, tmp_path):
    synthesise(tmp_path / "again", **TINY)
    synthesise(tmp_path / "other", **{**TINY, "seed": 4})
    again, other = contents(tmp_path / "again"), contents(tmp_path / "other")
    assert len(again) == 6 + 3 + 1
    assert contents(scene) == again
    assert again.keys() == other.keys() and all(again[k] != other[k] for k in again if k.name != "cameras.bin")


def test_the_geometry_has_exactly_the_numbers_that_were_rendered(scene):
    table, made = json.loads((scene / "geometry.json").read_text()), lay_out((1, 1), 3)
    assert [[box["low"], box["high"]] for box in table["boxes"]] == made.boxes.tolist()
    assert [KINDS.index(box["kind"]) for box in table["boxes"]] == made.kinds.tolist()
    assert [[*each["centre"], each["radius"]] for each in table["spheres"]] == made.spheres.tolist()
    assert (table["seed"], table["blocks"]) == (3, [1, 1])


@pytest.mark.parametrize(
    "option, value", [("--blocks", "0x1"), ("--views", "2"), ("--size", "0x36"), ("--size", "big"), ("--seed", "-1")]
)
def test_bad_numbers_are_refused_before_anything_is_written(tmp_path, option, value):
    with pytest.raises(SystemExit) as end:
        main([str(tmp_path / "scene"), option, value])
    assert end.value.code == 2 and not list(tmp_path.iterdir())
