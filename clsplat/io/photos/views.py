"""The photo of a view at its camera's size, and which of its pixels count."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clsplat.io.photos.images import image_bands, image_size, window_of
from clsplat.io.photos.lenses import pixel_map
from clsplat.io.photos.masks import stored_masks, unmasked
from clsplat.io.photos.resample import joined, resample
from clsplat.io.photos.undistort import undistorted_photo, undistorted_valid
from clsplat.scene import View


def read_photo(view: View) -> NDArray[np.uint8]:
    """Read the part of a view's photo that its camera shows, at the camera's size, as `read_image`
    does, and undistorted if it has a lens."""
    return joined(photo_bands(view), (view.camera.width, view.camera.height))


def photo_bands(view: View) -> Iterator[NDArray[np.uint8]]:
    """Yield the rows of `read_photo` from the top down, uint8[n, W, 3] each.

    Where the photo's format allows and it has no lens, only a few rows of it are in memory at once.
    """
    camera = view.camera
    size = camera.width, camera.height
    if view.lens is not None:
        pixels = undistorted_photo(view, pixel_map(view.lens))
        left, top, right, bottom = window_of(camera, (view.lens.width, view.lens.height))
        yield resample(pixels[top:bottom, left:right], size)
    elif camera.whole is None:
        yield from image_bands(view.source, size, levels=view.levels)
    else:
        yield from image_bands(view.source, size, window_of(camera, image_size(view.source)), view.levels)


def read_valid(view: View) -> NDArray[np.bool_] | None:
    """Which pixels of a view's photo count, bool[H, W] at its camera's size; None: all.

    A pixel of a reduced photo counts if all pixels do that it covers.
    """
    if view.lens is not None:
        whole = undistorted_valid(view, pixel_map(view.lens))
        masks = iter([] if whole is None else [whole])
    else:
        masks = stored_masks(view)
    valid: NDArray[np.bool_] | None = None
    camera = view.camera
    for mask in masks:
        left, top, right, bottom = window_of(camera, (mask.shape[1], mask.shape[0]))
        part = mask[top:bottom, left:right]
        if not part.all():
            small = unmasked(part, (camera.width, camera.height))
            valid = small if valid is None else valid & small
    return valid
