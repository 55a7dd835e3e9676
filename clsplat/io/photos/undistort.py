"""Undistorted photos with their masks and depth maps, and the files in which a run keeps them.

A file is made again if the lens, the photo, its mask or its depth map has changed; it appears whole
or not at all.
"""

import functools
import hashlib
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Lens
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.folders import make_folder
from clsplat.io.photos.depth import undistorted_depth
from clsplat.io.photos.images import image_size, read_image, write_image
from clsplat.io.photos.lenses import PANORAMA, pixel_map
from clsplat.io.photos.masks import stored_masks, unmasked
from clsplat.io.photos.resample import Patch, patches
from clsplat.scene import Scene, View

QUALITY = 98  # of JPEG; photos in other formats become PNG
FOLDER = "undistorted"  # of a run or a city
VERSION = 5  # of the undistorted files
HOST_BYTES = 640 << 20  # of the photos that are undistorted at the same time
PIXEL_BYTES = 10  # of a pixel, while it is undistorted in a thread, beside the map of the lens


def undistorted_photo(view: View, pixels: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Read the photo of a view with a lens and undistort it by the lens's `pixel_map`: uint8[H, W,
    3], black where the stored photo does not show it."""
    stored = read_image(view.source, levels=view.levels)
    photo = np.zeros((*pixels.shape[1:], 3), np.uint8)
    for part, shown, source, weights in _patches(view.lens, stored.shape, pixels):
        colours = weights @ stored[source].reshape(-1, 3).astype(np.float32)
        photo[part][shown] = np.clip(colours, 0, 255) + np.float32(0.5)
    return photo


def undistorted_valid(view: View, pixels: NDArray[np.float32]) -> NDArray[np.bool_] | None:
    """Read which pixels of a view with a lens count, bool[H, W]; None: all. Those do not that the
    stored photo does not show, or in which masked pixels have a share."""
    valid = np.isfinite(pixels[0])
    for mask in stored_masks(view):
        mask = unmasked(mask, image_size(view.source))
        for part, shown, source, weights in _patches(view.lens, mask.shape, pixels):
            masked = (~mask[source]).ravel().astype(np.float32)
            valid[part][shown] &= abs(weights) @ masked == 0
    return None if valid.all() else valid


def _patches(lens: Lens | None, shape: tuple[int, ...], pixels: NDArray[np.float32]) -> Iterator[Patch]:
    """The weights by which an image [h, w, ...] is undistorted, at pixels of the lens's size."""
    assert lens is not None
    size = shape[1], shape[0]
    scale = np.divide(size, lens.size).astype(np.float32)[:, None, None]
    return patches(pixels * scale, size, lens.model == PANORAMA)


def undistorted(scene: Scene, folder: Path, threads: int = 1, make: bool = True) -> Scene:
    """The scene with the files of undistorted photos and their masks in place of lenses.

    Parameters
    ----------
    folder : of the files; it is created if needed. Views whose photos are no files keep the lens.
    threads : that undistort photos, or fewer where these are so large that HOST_BYTES would not
        hold as many.
    make : whether files that are missing or out of date are made; else their views keep the lens.
    """
    groups: dict[Lens, list[View]] = {}  # views that share a map of pixels
    for view in scene.views:
        if view.lens and isinstance(view.source, Path):
            groups.setdefault(view.lens, []).append(view)
    if not groups:
        return scene
    if make:
        make_folder(folder)
    kept: dict[View, View] = {}
    largest = max(lens.width * lens.height for lens in groups)
    with ThreadPoolExecutor(max(1, min(threads, HOST_BYTES // (PIXEL_BYTES * largest)))) as pool:
        try:
            for lens, views in groups.items():
                stale = [view for view in views if not _kept(view, folder)] if make else []
                if stale:
                    list(pool.map(functools.partial(_make, folder, pixel_map(lens)), stale))
                kept |= {view: found for view in views if (found := _kept(view, folder))}
        finally:  # after a damaged photo or Ctrl-C, the others are not begun
            pool.shutdown(cancel_futures=True)
    return replace(scene, views=tuple(kept.get(view, view) for view in scene.views))


def _paths(view: View, folder: Path) -> tuple[Path, Path, Path]:
    """The undistorted photo of a view, its mask and its depth map, named after what they are made
    from."""
    lens = view.lens
    assert lens is not None and isinstance(view.source, Path)
    content = [
        VERSION,
        QUALITY,
        lens.model,
        lens.size,
        lens.parameters,
        lens.rotation.tolist(),
        lens.width,
        lens.height,
        lens.focal,
        lens.centre,
        view.transparent,
        view.levels,
        _file_facts(view.source),
        _file_facts(view.mask),
    ]
    stem = f"{_stem(view)}.{_digest(content)}"
    suffix = ".jpg" if view.source.suffix.lower() in (".jpg", ".jpeg") else ".png"
    return (
        folder / f"{stem}{suffix}",
        folder / f"{stem}.mask.png",
        folder / f"{stem}.{_digest(_file_facts(view.depth))}.npy",
    )


def _stem(view: View) -> str:
    readable = re.sub(r"[^\w.-]", "_", view.name, flags=re.ASCII)[:80]
    return f"{readable}.{_digest(view.name)}"


def _digest(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:16]


def _file_facts(path: object) -> tuple[str, int, int] | None:
    """By which a changed file is recognised; None without one."""
    if not isinstance(path, Path):
        return None
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); put it back") from None
    return path.name, status.st_size, status.st_mtime_ns


def _make(folder: Path, pixels: NDArray[np.float32], view: View) -> None:
    """Write the files of a view in place of older ones; the photo last."""
    photo, mask, depth = _paths(view, folder)
    for old in folder.glob(f"{_stem(view)}.*"):
        old.unlink()
    valid = undistorted_valid(view, pixels)
    if valid is not None:
        write_image(mask, np.repeat(valid[:, :, None], 3, axis=2) * np.uint8(255))
    if view.depth:
        with replacing(depth) as file:
            np.save(file, undistorted_depth(view, pixels), allow_pickle=False)
    write_image(photo, undistorted_photo(view, pixels), QUALITY)


def _kept(view: View, folder: Path) -> View | None:
    """The view with its files in place of its lens; None if they were made from another photo,
    mask, depth map or lens, or not at all."""
    photo, mask, depth = _paths(view, folder)
    if not photo.is_file() or view.depth and not depth.is_file():
        return None
    return replace(
        view,
        source=photo,
        lens=None,
        mask=mask if mask.is_file() else None,
        transparent=False,
        levels=None,
        depth=view.depth and depth,
    )
