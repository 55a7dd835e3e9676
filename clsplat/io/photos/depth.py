"""Depth maps of photos, such as of a laser scanner: depths along the camera's axis.

A map is FOLDER/NAME.png or FOLDER/NAME.jpg.png for the photo NAME.jpg, of any size: PNG, TIFF or
NPY with whole numbers, which are thousandths of the scene's unit (millimetres of a metre), or EXR,
TIFF or NPY with floats in the scene's units. Values that are zero, negative or not finite are none.
"""

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Lens
from clsplat.errors import InputError
from clsplat.io.fields import reading
from clsplat.io.photos.images import window_of
from clsplat.io.photos.lenses import pixel_map, rays_of
from clsplat.io.photos.masks import check_shape, photo_size
from clsplat.io.photos.photo import first_channel
from clsplat.scene import Scene, View

SUFFIXES = (".png", ".exr", ".tif", ".tiff", ".npy")
MILLIMETRE = 1e-3


def with_depths(scene: Scene, images: str) -> Scene:
    """The scene with the depth maps that a folder, relative to the scene's, has for its photos; "":
    none. A map that a view has stays."""
    if not images:
        return scene
    folder = (scene.path if scene.path.is_dir() else scene.path.parent) / images
    views = tuple(replace(view, depth=view.depth or map_of(folder, view)) for view in scene.views)
    if not any(view.depth for view in views):
        there = "no such folder" if not folder.is_dir() else "has no depth map for any photo"
        raise InputError(
            f"--depth {images}: {folder}: {there}; name the maps after the photos, such as {scene.views[0].name}.png"
        )
    return replace(scene, views=views)


def map_of(folder: Path, view: View) -> Path | None:
    """The depth map that a folder has for the photo of a view; None: it has none."""
    names = [PurePosixPath(view.name)]
    if isinstance(view.source, Path):  # whose name differs for the faces of a cube
        names.append(names[0].with_name(view.source.name))
    paths = (
        folder / f"{stem}{suffix}" for name in names for stem in (name, name.with_suffix("")) for suffix in SUFFIXES
    )
    return next((path for path in paths if path.is_file()), None)


def read_depth(view: View) -> NDArray[np.float32]:
    """Read a view's depth map, float32[H, W] at its camera's size, in the scene's original units; 0
    is no depth. The nearest value is taken, since means across an edge would be wrong."""
    whole = _stored(view) if view.lens is None else undistorted_depth(view, pixel_map(view.lens))
    height, width = whole.shape
    left, top, right, bottom = window_of(view.camera, (width, height))
    rows = _nearest(top, bottom, view.camera.height, height)
    return whole[rows[:, None], _nearest(left, right, view.camera.width, width)]


def _nearest(low: int, high: int, count: int, most: int) -> NDArray[np.int64]:
    places = low + (np.arange(count) + 0.5) * (high - low) / count
    return np.clip(places.astype(np.int64), 0, most - 1)


def undistorted_depth(view: View, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Read the depth map of a view with a lens and undistort it by the lens's `pixel_map`:
    float32[H, W] in the scene's original units; 0 is no depth."""
    depth, lens = _stored(view), view.lens
    assert lens is not None
    shown = np.isfinite(pixels[0])
    columns, rows = (
        np.clip((np.nan_to_num(places) * np.float32(side / size)).astype(int), 0, side - 1)
        for places, side, size in zip(pixels, depth.shape[::-1], lens.size)
    )
    return np.where(shown, depth[rows, columns] / _forward(lens), 0).astype(np.float32)


def _forward(lens: Lens) -> NDArray[np.float64]:
    """float64[H, W]: the depth along the stored photo's axis of points at depth 1; never 0."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    along = rays_of(lens, x.ravel(), y.ravel())[:, 2].reshape(x.shape)
    return np.where(along > 0, along, np.inf)  # behind that camera there is no depth


def _stored(view: View) -> NDArray[np.float32]:
    """The depth map as it is stored, float32[h, w], in the scene's original units."""
    path = view.depth
    assert path is not None
    values = _read_npy(path) if path.suffix == ".npy" else first_channel(path)
    check_shape(path, "depth map", values.shape[::-1], photo_size(view))
    if values.dtype.kind in "iu":
        values = values * np.float32(MILLIMETRE)
    with np.errstate(invalid="ignore", over="ignore"):
        depth = values.astype(np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _read_npy(path: Path) -> NDArray[Any]:
    with reading(path, "a NumPy array", "save it again"):
        # mapped, as numpy otherwise allocates what a header claims
        values: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
        if values.ndim != 2 or values.dtype.kind not in "iuf" or not values.size:
            raise InputError(
                f"{path}: holds {values.dtype}{list(values.shape)}, not numbers [H, W]; save the depths as such"
            )
    return values
