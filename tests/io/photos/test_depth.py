"""Depth maps of all formats, at any size, and messages about those that do not fit."""

from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest

from clsplat.io.photos.depth import map_of, read_depth, with_depths
from clsplat.io.photos.images import write_image
from clsplat.io.photos.lenses import undistorted_model
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_model import HEIGHT, WIDTH, write_scene
from tests.io.photos.test_lenses import DISTORTION, arrays_of, views_of
from tests.refusals import refused

METRES = np.random.default_rng(0).integers(500, 60000, (HEIGHT, WIDTH)) / 1000


@pytest.fixture
def folder(tmp_path):
    (write_scene(tmp_path / "town") / "laser").mkdir()
    return tmp_path / "town"


def write(path, values):
    output = oiio.ImageOutput.create(str(path))
    kind = oiio.UINT16 if values.dtype.kind == "u" else oiio.FLOAT
    assert output.open(str(path), oiio.ImageSpec(values.shape[1], values.shape[0], 1, kind))
    assert output.write_image(np.ascontiguousarray(values[..., None])) and output.close()


MILLIMETRES, FLOATS = (METRES * 1000).round().astype(np.uint16), METRES.astype(np.float32)


@pytest.mark.parametrize(
    "name, values",
    [
        ("photo_1.png.png", MILLIMETRES),
        ("photo_1.tif", MILLIMETRES),
        ("photo_1.exr", FLOATS),
        ("photo_1.npy", METRES),
        ("photo_1.npy", MILLIMETRES),
    ],
)
def test_formats(folder, name, values):
    path = folder / "laser" / name
    np.save(path, values) if path.suffix == ".npy" else write(path, values)
    scene = with_depths(read_scene(folder), "laser")
    assert [view.depth for view in scene.views] == [None, path, None, None]
    assert np.allclose(read_depth(scene.views[1]), METRES, rtol=1e-6)
    assert with_depths(scene, "laser").views[1].depth == path and with_depths(scene, "") is scene


def test_no_depth_where_there_is_none(folder):
    values = METRES.copy()
    values[0, :5] = 0, np.nan, np.inf, -np.inf, -2
    np.save(folder / "laser/photo_1.npy", values)
    depth = read_depth(with_depths(read_scene(folder), "laser").views[1])
    assert not depth[0, :5].any() and np.allclose(depth[1:], METRES[1:])


def test_the_nearest_value_at_other_sizes(folder):
    np.save(folder / "laser/photo_1.npy", METRES)
    scene = with_depths(read_scene(folder), "laser")
    small = read_depth(scene.reduced(3).views[1])
    assert np.allclose(small, METRES[1::3, 1::3])
    part = scene.cropped({"photo_1.png": (6, 3, 30, 27)}).reduced(2).views[1]
    assert np.allclose(read_depth(part), METRES[4:27:2, 7:30:2])
    np.save(folder / "laser/photo_1.npy", METRES[::2, ::2])
    large = read_depth(scene.views[1])
    assert np.allclose(large, METRES[::2, ::2].repeat(2, 0).repeat(2, 1))


def test_a_plane_in_the_faces_of_a_wide_lens(tmp_path):
    """The map of a photo is that of all its faces, whose depths are along other axes."""
    size, values = (160, 150), (45.0, 45.0, 80.0, 75.0, *DISTORTION["OPENCV_FISHEYE"])
    np.save(tmp_path / "a.png.npy", np.full((150, 160), 5.0))
    arrays = undistorted_model("made", arrays_of(["a.png"], size), [("OPENCV_FISHEYE", values)])
    shares = {}
    for view in views_of(arrays, tmp_path / "a.png"):
        camera = view.camera
        depth = read_depth(replace(view, depth=map_of(tmp_path, view)))
        rows, columns = np.nonzero(depth)
        inside = (np.stack([columns, rows], axis=1) + 0.5 - camera.centre) / camera.focal
        rays = np.column_stack([inside, np.ones(len(rows))]) @ camera.rotation
        assert np.allclose(rays[:, 2] * depth[rows, columns], 5, rtol=1e-5)
        shares[view.name] = len(rows) / depth.size
    assert shares["a.front.png"] == 1 and 0.2 < shares["a.left.png"] < 0.6, shares


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda f: None, "--depth laser: .*has no depth map for any photo.*photo_0.png.png"),
        (lambda f: write_image(f / "photo_1.png", np.zeros((HEIGHT, WIDTH, 3))), "samples of uint8"),
        (lambda f: np.save(f / "photo_1.npy", METRES[:20]), "48x20 pixels and its photo 48x36"),
        (lambda f: np.save(f / "photo_1.npy", METRES[None]), "float64[1, 36, 48], not numbers"),
        (lambda f: (f / "photo_1.npy").write_bytes(b""), "photo_1.npy: not a NumPy array"),
    ],
)
def test_maps_that_do_not_fit(folder, spoil, words):
    spoil(folder / "laser")
    refused(lambda: read_depth(with_depths(read_scene(folder), "laser").views[1]), *words.split(".*"))
