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
from typing import Any

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
from clsplat.io.records import object_of, write_object
from clsplat.scene import Scene, View

DEPTH = ".depth.npy"
QUALITY = 98  # of JPEG; photos in other formats become PNG
FOLDER = "undistorted"  # of a run or a city
VERSION = 3  # of the undistorted files
HOST_BYTES = 640 << 20  # of the photos that are undistorted at the same time
PIXEL_BYTES = 10  # of a pixel, while it is undistorted in a thread, beside the map of the lens


def undistorted_photo(view: View, pixels: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Read the photo of a view with a lens and undistort it by the lens's `pixel_map`: uint8[H, W,
    3], black where the stored photo does not show it."""
    stored = read_image(view.source, levels=view.levels)
    photo = np.zeros((*pixels.shape[1:], 3), np.uint8)
    for patch in _patches(view.lens, stored.shape, pixels):
        source = stored[patch.source].reshape(-1, 3).astype(np.float32)
        photo[patch.part][patch.shown] = np.clip(patch.weights @ source, 0, 255) + np.float32(0.5)
    return photo


def undistorted_valid(view: View, pixels: NDArray[np.float32]) -> NDArray[np.bool_] | None:
    """Read which pixels of a view with a lens count, bool[H, W]; None: all. Those do not that the
    stored photo does not show, or in which masked pixels have a share."""
    valid = np.isfinite(pixels[0])
    for mask in stored_masks(view):
        mask = unmasked(mask, image_size(view.source))
        for patch in _patches(view.lens, mask.shape, pixels):
            masked = (~mask[patch.source]).ravel().astype(np.float32)
            valid[patch.part][patch.shown] &= abs(patch.weights) @ masked == 0
    return None if valid.all() else valid


def _patches(lens: Lens | None, shape: tuple[int, ...], pixels: NDArray[np.float32]
             ) -> Iterator[Patch]:
    """The weights by which an image [h, w, ...] is undistorted, at pixels of the lens's size."""
    assert lens is not None
    height, width = shape[:2]
    scale = np.array([[[width / lens.size[0]]], [[height / lens.size[1]]]], np.float32)
    return patches(pixels * scale, (width, height), lens.model == PANORAMA)


def undistorted(scene: Scene, folder: Path, threads: int = 1, make: bool = True) -> Scene:
    """The scene with the files of undistorted photos and their masks in place of lenses.

    Parameters
    ----------
    folder : of the files; it is created if needed. Views whose photos are no files keep the lens.
    threads : that undistort photos, or fewer where these are so large that HOST_BYTES would not
        hold as many.
    make : whether files that are missing or out of date are made; else their views keep the lens.
    """
    distorted = [view for view in scene.views if view.lens and isinstance(view.source, Path)]
    if not distorted:
        return scene
    if make:
        make_folder(folder)
    groups: dict[Lens, list[View]] = {}  # views that share a map of pixels
    for view in distorted:
        assert view.lens is not None
        groups.setdefault(view.lens, []).append(view)
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
    """The files of a view: its undistorted photo, its mask and the record of both."""
    assert isinstance(view.source, Path)
    readable = re.sub(r"[^\w.-]", "_", view.name, flags=re.ASCII)[:80]
    stem = f"{readable}.{hashlib.sha256(view.name.encode()).hexdigest()[:8]}"
    suffix = ".jpg" if view.source.suffix.lower() in (".jpg", ".jpeg") else ".png"
    return folder / f"{stem}{suffix}", folder / f"{stem}.mask.png", folder / f"{stem}.json"


def _make(folder: Path, pixels: NDArray[np.float32], view: View) -> None:
    """Write the files of a view; the record last."""
    content, known_depth = _content(view), _file_facts(view.depth)
    path, mask, record = _paths(view, folder)
    write_image(path, undistorted_photo(view, pixels), QUALITY)
    valid = undistorted_valid(view, pixels)
    if valid is not None:
        write_image(mask, np.repeat(valid[:, :, None], 3, axis=2) * np.uint8(255))
    if view.depth:
        depth = undistorted_depth(view, pixels)
        with replacing(path.with_suffix(DEPTH)) as file:
            np.save(file, depth, allow_pickle=False)
    write_object(record, {"content": content, "masked": valid is not None, "depth": known_depth})


def _kept(view: View, folder: Path) -> View | None:
    """The view with its files in place of its lens; None if one is missing, or if they were made
    from another photo, mask, depth map or lens."""
    photo, mask, record = _paths(view, folder)
    try:
        known = object_of(record.read_bytes())
        found = replace(view, source=photo, lens=None, mask=mask if known["masked"] else None,
                        transparent=False, levels=None,
                        depth=view.depth and photo.with_suffix(DEPTH))
    except (OSError, ValueError, KeyError):
        return None
    files = [path for path in (photo, found.mask, found.depth) if isinstance(path, Path)]
    fresh = (known.get("content") == _content(view) and all(path.is_file() for path in files)
             and (view.depth is None or known.get("depth") == _file_facts(view.depth)))
    return found if fresh else None


def _content(view: View) -> str:
    """A digest of all that an undistorted photo and its mask are made from."""
    lens = view.lens
    assert lens is not None
    facts = [VERSION, QUALITY, lens.model, lens.size, lens.parameters, lens.rotation.tolist(),
             lens.width, lens.height, lens.focal, lens.centre, view.transparent, view.levels,
             _file_facts(view.source), _file_facts(view.mask)]
    return hashlib.sha256(repr(facts).encode()).hexdigest()


def _file_facts(path: object) -> list[Any] | None:
    """By which a changed file is recognised; None without one."""
    if not isinstance(path, Path):
        return None
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); put it back") from None
    return [path.name, status.st_size, status.st_mtime_ns]
