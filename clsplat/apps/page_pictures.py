"""The pictures of a page of a model: small copies of its photos, and a poster of its first view."""

import math
import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.models import in_original
from clsplat.device import choose_device
from clsplat.errors import ClsplatError
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import render_view
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.photos.images import eight_bits, encode_image
from clsplat.io.photos.views import read_photo
from clsplat.rendering.slabs import open_model
from clsplat.report.encode import Progress
from clsplat.report.model_page import Photo, near_of
from clsplat.scene import Scene, View

MOST_BYTES = 8 << 20  # of the pictures of all photos
LONGEST_SIDE, SHORTEST_SIDE = 800, 64  # pixels, of the longer side of a picture
PIXEL_BYTES = 0.3  # of a JPEG of this quality, about
QUALITIES = (80, 65, 50, 35, 20)  # the first that fits
POSTER_SIDE, POSTER_QUALITY = 900, 70


def photos_of_page(scene: Scene, pictures: bool, progress: Progress = lambda *_: None) -> list[Photo]:
    """The photos of a scene, upright, for `write_page`.

    Parameters
    ----------
    scene : as `Run.scene` returns it.
    pictures : whether small copies of the photos, of MOST_BYTES in all at most, are wanted.
    progress : called with "photo", and how many of them are read and there are.
    """
    turns = [view.quarter_turns for view in scene.views]
    found = [
        Photo(view.name, camera.turned(turn)) for view, camera, turn in zip(scene.views, in_original(scene), turns)
    ]
    if not pictures:
        return found
    side = int(np.clip(math.sqrt(MOST_BYTES / PIXEL_BYTES / len(found)), SHORTEST_SIDE, LONGEST_SIDE))
    small, threads = [], os.cpu_count() or 1
    for pixels in called_ahead(lambda view: _small(view, side), zip(scene.views), threads, threads):
        small.append(pixels)
        progress("photo", len(small), len(found))
    return [replace(photo, picture=picture) for photo, picture in zip(found, _encoded(small))]


def _small(view: View, side: int) -> NDArray[np.uint8] | None:
    """A photo of at most `side` pixels a side, upright; None if it cannot be read."""
    try:
        pixels = read_photo(replace(view, camera=view.camera.reduced(1.0, side)))
    except (ClsplatError, OSError):
        return None
    return np.ascontiguousarray(np.rot90(pixels, -view.quarter_turns))


def _encoded(pictures: Sequence[NDArray[np.uint8] | None]) -> list[bytes]:
    """JPEGs of MOST_BYTES in all at most; those that do not fit at the lowest quality are b""."""
    for quality in QUALITIES:
        result = [b"" if pixels is None else encode_image(pixels, "jpg", quality, "JPEG") for pixels in pictures]
        if sum(map(len, result)) <= MOST_BYTES:
            return result
    ends = np.cumsum([len(each) for each in result])
    return [each if end <= MOST_BYTES else b"" for each, end in zip(result, ends)]


def poster_of(run: Run, gaussians: Gaussians, device: str) -> bytes:
    """A JPEG of the first view of a run, of gaussians in original coordinates up to their offset,
    drawn by the device of this name."""
    view = run.first_view
    camera = view.reduced(1.0, POSTER_SIDE).shifted(gaussians.offset - view.offset)
    opened = open_model(choose_device(device), gaussians, near_of(run), run.options.antialiased, run.options.background)
    return encode_image(eight_bits(render_view(*opened, gaussians.sh_degree, camera)), "jpg", POSTER_QUALITY, "JPEG")
