"""Large synthetic surveys: the device draws what the reference in numpy draws, its sparse points
are where the reference sees them, and the photos lie where a drone would take them."""

import json

import numpy as np
import pytest

from clsplat.io.photos.metadata import read_metadata
from clsplat.io.scenes.read import read_scene
from tests.tools.test_synth import contents, distance
from tools.synth import raycast
from tools.synth.__main__ import main
from tools.synth.city import lay_out, sample_solids
from tools.synth.draw import DeviceCity, grid_of
from tools.synth.large import synthesise_large
from tools.synth.sparse import observe_on
from tools.synth.survey import blocks_for, fly, focal_of, gains, looking, overlap_of
from tools.synth.texture import Texture

DETAIL = 0.08
SIZE = (96, 72)
PIXEL = 30 / focal_of(SIZE[0])  # world units


@pytest.fixture(scope="module")
def city():
    return lay_out((2, 1), 3, small=True)


@pytest.fixture(scope="module")
def flown():
    city = lay_out((1, 1), 0, small=True)
    return city, fly(city, 14, *SIZE, PIXEL)


@pytest.mark.parametrize("detail", [0.0, DETAIL])
@pytest.mark.parametrize(
    "position, forward",
    [
        ((3, -16, 21), (0.1, 0.7, -1)),  # obliquely from above
        ((9.5, 2, 1.5), (0.1, 1, 0.1)),
    ],
)  # down a street: sky, and rays along the axes
def test_a_photo_is_that_of_the_reference(device, city, detail, position, forward):
    camera = looking(np.array(position, float), np.array(forward, float), np.array([0, 0, 1.0]), 40, 30)
    texture, light = Texture(city, detail), (1.1, 1.0, 0.9)
    expected = raycast.render(texture, camera, light).astype(int)
    image = DeviceCity(device, texture).photo(camera, light).values()
    off = np.abs(image - expected)
    assert expected.std() > 20
    assert off.mean() < 0.02 and (off.max(axis=2) > 2).mean() < 0.005  # of 255; at edges


def test_the_grid_has_every_solid_in_the_cells_below_it(city):
    (x, y, cell, top), (columns, _), begins, members, tops = grid_of(city)
    assert top == tops.max() and len(begins) == len(tops) + 1
    lists = [set(members[a:b].tolist()) for a, b in zip(begins, begins[1:])]
    rng = np.random.default_rng(0)
    for solid, (low, high) in enumerate(city.bounds, 1):
        for place in rng.uniform(low, high, (20, 3)):
            column, row = np.floor((place[:2] - (x, y)) / cell).astype(int)
            assert solid in lists[row * columns + column]
            assert tops[row * columns + column] >= high[2]


def test_small_parts_and_detail_change_nothing_else(city):
    plain = lay_out((2, 1), 3)
    count = len(plain.boxes)
    assert (city.boxes[:count] == plain.boxes).all() and len(city.boxes) > 1.5 * count
    assert (city.spheres[: len(plain.spheres)] == plain.spheres).all()


def test_sampled_points_lie_on_their_primitives(city):
    points, solids = sample_solids(city, 3000, 0.0, np.random.default_rng(0))
    low, high = city.bounds[solids[solids > 0] - 1].transpose(1, 0, 2)
    on = points[solids > 0]
    assert (on > low - 1e-9).all() and (on < high + 1e-9).all()
    assert (points[solids == 0, 2] == 0).all() and len(np.unique(solids)) > 200


@pytest.mark.slow
@pytest.mark.one_in(2)
def test_points_are_seen_where_the_reference_sees_them(float_device, flown):
    city, cameras = flown
    sparse = observe_on(DeviceCity(float_device, Texture(city, PIXEL)), city, cameras, 3000)
    assert len(sparse.points) == len(sparse.colours) == 3000
    assert (np.bincount(sparse.point, minlength=3000) >= 2).all()
    assert (np.diff(sparse.point) >= 0).all()
    assert distance(city, sparse.points).max() < 3 * PIXEL
    for number, camera in enumerate(cameras):
        rows = sparse.view == number
        projected, _ = camera.project(sparse.points[sparse.point[rows]])
        error = np.linalg.norm(projected - sparse.pixels[rows], axis=1)
        assert 0.2 < error.mean() < 0.8 and error.max() < 3.5
        # except where noise moves it past an edge
        met, _ = raycast.cast(city, camera, projected)
        assert (np.linalg.norm(met - sparse.points[sparse.point[rows]], axis=1) < 1).mean() > 0.9


@pytest.mark.parametrize("views, blocks", [(400, 5), (1600, 11), (6000, 21)])
@pytest.mark.one_in(3)
def test_cities_grow_with_the_photos_at_the_same_pixel_and_overlap(views, blocks):
    size, pixel = (1152, 864), 0.03
    assert blocks_for(views, *size, pixel) == blocks
    city = lay_out((blocks, blocks))
    assert 0.73 < overlap_of(city, views, *size, pixel) < 0.79
    nadir = fly(city, views, *size, pixel)[: views // 2]
    heights = np.array([camera.position[2] for camera in nadir])
    assert heights / nadir[0].focal[0] == pytest.approx(pixel, rel=0.04)
    steps = np.diff([camera.position[0] for camera in nadir])
    assert np.median(np.abs(steps)) == pytest.approx(0.245 * size[0] * pixel, rel=0.1)


def test_gains_drift_slowly_within_the_limit():
    light = gains(400, 0.15, 1)
    assert light[:, 1].max() == pytest.approx(1.15) or light[:, 1].min() == pytest.approx(1 / 1.15)
    assert np.abs(np.diff(np.log(light), axis=0)).max() < 0.02
    balance = light[:, 0] / light[:, 2]
    assert 0.02 < np.abs(np.log(balance)).max() < 0.1
    assert (gains(5, 0.0) == 1).all()


@pytest.mark.slow
def test_a_survey_is_a_scene_with_gps_and_the_same_bytes_again(item_device, tmp_path):
    made = [
        synthesise_large(tmp_path / name, item_device, 10, SIZE, PIXEL, points=400, drift=0.1)
        for name in ("first", "again")
    ]
    assert contents(tmp_path / "first") == contents(tmp_path / "again")
    assert made[0] == made[1] and made[0].points == 400
    scene = read_scene(tmp_path / "first")
    assert len(scene.views) == 10 and len(scene.points) == 400
    known = read_metadata(tmp_path / "first" / "images" / "000.jpg")
    assert known.latitude == pytest.approx(47.85, abs=0.01)
    assert known.longitude == pytest.approx(9.0, abs=0.01)
    assert known.altitude == pytest.approx(450 + 120, abs=12)
    table = json.loads((tmp_path / "first" / "geometry.json").read_text())
    assert table["gains"] == gains(10, 0.1).tolist()


@pytest.mark.parametrize(
    "options",
    [
        ("--large", "--pixel", "0.01"),
        ("--large", "--drift", "2"),
        ("--large", "--points", "-5"),
        ("--large", "--device", "abacus"),
        ("--drift", "0.1"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(tmp_path, options):
    with pytest.raises(SystemExit) as end:
        main([str(tmp_path / "scene"), *options])
    assert end.value.code == 2 and not list(tmp_path.iterdir())
