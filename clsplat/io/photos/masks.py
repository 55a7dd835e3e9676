"""Masks of photos: which pixels count in training and in scores.

A mask is an image in masks/ beside the photos, or has a name by which io/photos/mask_files.py
finds it: dark pixels do not count. Nor do transparent pixels of a photo with alpha, and those that
a lens does not show.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.photos.beside import check_shape, photo_size
from clsplat.io.photos.images import read_alpha
from clsplat.io.photos.mask_files import MaskFiles, mask_folders
from clsplat.io.photos.photo import Source, opened
from clsplat.io.photos.resample import resample
from clsplat.scene import Scene, View

LEAST_BRIGHT = 128  # of 255, of pixels that count


def with_masks(scene: Scene, folder: Path) -> Scene:
    """The scene with the masks that its folder has for its photos, and a note."""
    folders = mask_folders(folder)
    files = MaskFiles(folders)
    views = tuple(view if view.mask is not None else replace(view, mask=files.of(
        view.name, view.source if isinstance(view.source, Path) else None))
        for view in scene.views)
    count = sum(view.mask is not None for view in views)
    if folders and not count:
        raise InputError(f"{folders[0]}: has no mask for any photo; name them after the photos,"
                         f" such as {scene.views[0].name}.png, or rename the folder")
    if not files.used and not folders:
        return replace(scene, views=views)
    places = sorted({mask.parent.name for mask in files.used})
    where = f" in {', '.join(f'{place}/' for place in places)}" if places else ""
    note = (f"{count} of {len(views)} photos have a mask{where}: dark pixels are left out of "
            "training and scores")
    return replace(scene, views=views, notes=(*scene.notes, note))


def stored_masks(view: View) -> Iterator[NDArray[np.bool_]]:
    """Yield the masks of a view's photo as it is stored, bool[h, w] of any size each."""
    if view.mask is not None:
        name = view.mask if isinstance(view.mask, Path) else f"the mask of {view.name}"
        yield read_mask(view.mask, name, photo_size(view))
    if view.transparent:
        yield read_alpha(view.source) >= LEAST_BRIGHT


def read_mask(source: Source, name: str | Path, photo: tuple[int, int]) -> NDArray[np.bool_]:
    """Read which pixels of a photo count, by its mask: bool[h, w], of any size.

    Parameters
    ----------
    source : of the mask.
    name : for messages.
    photo : (width, height) of the photo as it is stored, pixels.

    Raises
    ------
    InputError : the mask is not an image that can be read, or does not fit.
    """
    with opened(source) as mask:
        bright, row, most = np.empty((mask.height, mask.width), bool), 0, 0
        for band in mask.bands(0, mask.height):
            grey = band.max(axis=2)
            bright[row:row + len(band)] = grey >= LEAST_BRIGHT
            row, most = row + len(band), max(most, int(grey.max()))
    check_shape(name, "mask", bright.shape[::-1], photo)
    if most == 1:
        raise InputError(f"{name}: its pixels are 0 and 1 of 255, which are both dark; write 255 "
                         "where the photo counts")
    return bright


def unmasked(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Bring a mask to another size; a pixel counts if all pixels do that it covers.

    Parameters
    ----------
    mask : bool[h, w].
    size : (width, height) of the result.
    """
    if mask.all():
        return np.ones(size[::-1], bool)
    share = resample(mask[:, :, None] * np.uint8(255), size)[:, :, 0]
    valid: NDArray[np.bool_] = share == 255
    return valid
