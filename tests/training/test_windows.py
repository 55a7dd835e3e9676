"""A view of a block shows the part of its photo that the block is in, as the whole photo would."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.io.photos.images import read_image, write_image
from clsplat.io.photos.resample import resample
from clsplat.io.photos.views import read_photo
from clsplat.io.runs.city import CityFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.partition import windows as partition_windows
from clsplat.partition.region import world_of
from clsplat.partition.windows import find_windows
from clsplat.rendering.slabs import Parts, SlabRenderer
from clsplat.scene import View
from tests import cases
from tests.city.test_block import region_of
from tests.data.tiny_training import CITY
from tests.kernels import chain


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


@pytest.fixture(scope="module")
def gaussians(scene):
    return Gaussians.from_points(scene.points, scene.colours, 0)


CAMERA = Camera(640, 480, (500.0, 510.0), (321.0, 244.0), np.eye(3), np.zeros(3))
POINTS = np.random.default_rng(0).normal(0, 1, (50, 3)) + [0, 0, 4]


def test_a_part_of_a_photo_shows_what_the_whole_does_there():
    part = CAMERA.cropped(96, 32, 400, 288)
    assert (part.width, part.height) == (304, 256)
    assert np.allclose(part.project(POINTS)[0], CAMERA.project(POINTS)[0] - [96, 32])
    assert part.borders == (-96, -32, 544, 448)
    again = part.cropped(10, 20, 200, 200)
    assert again.borders == (-106, -52, 534, 428)
    assert np.allclose(again.project(POINTS)[0], CAMERA.project(POINTS)[0] - [106, 52])
    half = part.reduced(2)
    assert (half.width, half.height, half.borders) == (152, 128, (-48, -16, 272, 224))


@pytest.mark.parametrize("name", ["ragged", "giants", "near_plane"])
def test_a_render_of_a_part_is_part_of_the_render(device, name):
    """Also where gaussians lie far outside the part: what clamps their Jacobians is the whole."""
    case = cases.gaussians(name)
    width, height = chain.size_of(case)
    left, top, right, bottom = window = width // 2, height // 3, width - 3, height - 1
    renderer, rows, camera = (
        chain.renderer_of(device, case),
        chain.upload_rows(device, case["rows"]),
        chain.camera_of(case),
    )

    def drawn(camera):
        frame = renderer.render(rows, renderer.pack(camera), camera.width, camera.height, case["degree"])
        return frame.image.download()

    expected = drawn(camera)[:, top:bottom, left:right]
    part = camera.cropped(*window)
    assert abs(drawn(part) - expected).max() < 2e-6 * (1 + abs(expected).max())
    slabs = SlabRenderer(device, chain.stored_degree(case), case["near"], background=case["background"])
    frame = slabs.render(Parts.of(case["rows"], 16), slabs.pack(part), part.width, part.height, case["degree"])
    assert abs(frame.image.download() - expected).max() < 2e-6 * (1 + abs(expected).max())
    if name == "giants":  # the case would notice
        assert abs(drawn(replace(part, whole=None)) - expected).max() > 2e-5


def test_a_photo_is_read_in_part(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    write_image(tmp_path / "a.png", pixels)
    part = CAMERA.cropped(96, 32, 400, 288)

    def read(camera):
        return read_photo(View("a", camera, tmp_path / "a.png"))

    assert np.array_equal(read(part), pixels[32:288, 96:400])
    for factor, size in ((2, (152, 128)), (3, (101, 85))):
        assert np.array_equal(read(part.reduced(factor)), resample(pixels[32:288, 96:400], size))
    assert np.array_equal(read(CAMERA.reduced(2)), read_image(tmp_path / "a.png", (320, 240)))


@pytest.mark.parametrize("most, share", [(10**6, 0.98), (500, 0.95)])
def test_windows_hold_what_the_region_reaches(scene, gaussians, monkeypatch, most, share):
    """Of many gaussians some are asked."""
    monkeypatch.setattr(partition_windows, "MOST_BOUNDED", most)
    region = region_of(scene, 0.3, 0.1)
    windows = find_windows(gaussians, scene, region, scene.views)
    reached = region.reaches(world_of(scene, gaussians.positions))
    assert len(windows) > 20
    areas, shown = [], []
    for view in scene.views:
        size = view.camera.width, view.camera.height
        left, top, right, bottom = windows.get(view.name, (0, 0, *size))
        assert left % 16 == top % 16 == 0
        assert right % 16 == 0 or right == size[0]
        assert bottom % 16 == 0 or bottom == size[1]
        assert right - left >= 48 and bottom - top >= 48  # 64 but for the photo's end
        areas.append((right - left) * (bottom - top) / np.prod(size))
        pixels, _ = view.camera.project(gaussians.positions[reached & view.sees(scene.points)])
        shown.append(((pixels > (left, top)) & (pixels < (right, bottom))).all(axis=1))
    assert np.concatenate(shown).mean() > share and np.mean(areas) < 0.75


def test_a_scene_cropped_keeps_the_observations_that_it_shows(scene):
    view = scene.views[5]
    cropped = scene.cropped({view.name: (64, 32, 192, 160)})
    point, number = scene.observations.T
    pixels, _ = view.camera.project(scene.points[point])
    inside = (number != 5) | ((pixels > (64, 32)) & (pixels < (192, 160))).all(axis=1)
    assert 0 < (~inside).sum() < (number == 5).sum()
    assert np.array_equal(cropped.observations, scene.observations[inside])
    assert cropped.views[5].camera.width == 128 and cropped.views[4] is scene.views[4]
    assert replace(scene, observations=None).cropped({}).observations is None


@pytest.fixture
def block(scene, gaussians, tmp_path):
    city = CityFolder(tmp_path / "city")
    city.path.mkdir(parents=True, exist_ok=True)
    city.write({"fingerprint": fingerprint(scene)})
    city.write_partition({"method": "by hand"})
    return city.write_block(
        0,
        scene,
        [3, 8],
        region_of(scene, 0.3, 0.1),
        {scene.views[3].name: (16, 32, 128, 160)},
        gaussians,
        None,
        {},
        city.identity(),
    )


def test_a_block_is_read_with_its_windows(block, scene):
    first, second = read_scene(block.path).views
    assert (first.camera.width, first.camera.height) == (112, 128)
    assert np.allclose(first.camera.borders, (-16, -32, 304, 208))
    assert second.camera.width == 320 and second.camera.whole is None
    assert np.array_equal(read_photo(first), read_image(scene.views[3].source)[32:160, 16:128])
