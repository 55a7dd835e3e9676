"""The photos of a scene: their folder, whether they fit their cameras, and notes on their content.

Only headers are read here, and samples of photos with 16 bits.
"""

import os
import re
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from clsplat.camera import Lens
from clsplat.errors import MOST_CHARACTERS, InputError
from clsplat.io.photos.decoded import HEIC_SUFFIXES, RAW_SUFFIXES
from clsplat.io.photos.metadata import QUARTERS
from clsplat.io.photos.photo import Photo, common_levels, opened
from clsplat.scene import Scene, View

# of files that may be photos; what they are follows from their content
PHOTO_SUFFIXES = (
    ".jpg",
    ".jpeg",
    ".png",
    ".tif",
    ".tiff",
    ".webp",
    ".bmp",
    ".jp2",
    ".jxl",
    ".ppm",
    ".pgm",
    ".tga",
    ".gif",
    *HEIC_SUFFIXES,
    *RAW_SUFFIXES,
)
IMAGES, SMALLER = "images", re.compile(r"images_(\d+)")  # as in Mip-NeRF 360
ROUNDING = 1.5  # pixels, the tolerance of the size of a smaller photo
QUARTER_TURNS = (5, 6, 7, 8)  # EXIF orientations that swap width and height


def photo_folder(folder: Path, images: str = "") -> Path:
    """The folder of a scene's photos.

    Parameters
    ----------
    folder : of the scene.
    images : relative to it; "": images/, or else the first of images_2/, images_4/, ...
    """
    numbered = sorted(
        (path for path in folder.glob("images_*") if SMALLER.fullmatch(path.name) and path.is_dir()),
        key=lambda path: int(path.name.rpartition("_")[2]),
    )
    present = [folder / IMAGES] * (folder / IMAGES).is_dir() + numbered
    if not images:
        return present[0] if present else folder / IMAGES
    if os.path.isdir(folder / images):
        return folder / images
    names = ", ".join(path.name for path in present) or "none with photos"
    raise InputError(f"--images {images}: {folder} has no such folder; there is {names}")


def checked_photos(scene: Scene, smaller: Path | None = None) -> Scene:
    """Check that every photo exists in its camera's size, and add notes on the photos to the scene.

    Parameters
    ----------
    smaller : a folder whose photos may all be smaller than their cameras by one factor, by which
        the cameras are then scaled.
    """
    missing = [view.source for view in scene.views if isinstance(view.source, Path) and not os.path.exists(view.source)]
    if missing:
        raise InputError(
            f"{str(missing[0])[:MOST_CHARACTERS]}: no such image ({len(missing)} of "
            f"{len(scene.views)} images of the model are missing); "
            f"{_where_else(missing[0])}"
        )
    photos = []
    for view in scene.views:
        with opened(view.source) as photo:
            photos.append(photo)
    levels, deep = common_levels([view.source for view in scene.views], [photo.is_deep for photo in photos])
    notes = [*scene.notes, *_notes(scene.views, photos), *deep]
    factor = 1.0
    if smaller:
        factor = float(np.median([_stored_size(view)[0] / photo.width for view, photo in zip(scene.views, photos)]))
        if smaller.name != IMAGES or factor != 1:
            size = (
                "as large as the model's cameras"
                if factor == 1
                else f"{factor:.3g} times smaller than the model's cameras, which are scaled to fit"
            )
            notes.insert(0, f"photos are those of {smaller.name}/, {size}")
    resized = cache(Lens.resized)  # views share a lens, and with it the map of its pixels
    views = tuple(
        replace(_fitted(view, photo, factor, resized), levels=each)
        for view, photo, each in zip(scene.views, photos, levels)
    )
    return replace(scene, views=views, notes=tuple(notes))


def _where_else(path: Path) -> str:
    """The cure for a missing photo, which depends on the other files of its folder."""

    def folded(name: str) -> str:
        return unicodedata.normalize("NFC", Path(name).stem).casefold()

    names = sorted(os.listdir(path.parent)) if path.parent.is_dir() else []
    alike = [name for name in names if folded(name) == folded(path.name)]
    if alike:
        return (
            f"{alike[0]!a} is there, which differs in letter case, in the form of its "
            "characters or in its suffix: rename or convert it"
        )
    return "put the photos there, or name their folder with --images"


def _stored_size(view: View) -> tuple[int, int]:
    """(width, height) that a view's photo should have, pixels."""
    return view.lens.size if view.lens else (view.camera.width, view.camera.height)


def _notes(views: Sequence[View], photos: Sequence[Photo]) -> Iterator[str]:
    """Notes about lenses, and about what of the photos is converted, left out or ambiguous."""
    lenses = [view.lens for view in views if view.lens]
    if lenses:
        models = ", ".join(sorted({lens.model for lens in lenses}))
        sizes = sorted({(lens.width, lens.height) for lens in lenses})
        size = f"{sizes[-1][0]}x{sizes[-1][1]}" + " and other sizes" * (len(sizes) > 1)
        yield (
            f"{len(lenses)} of {len(views)} views are undistorted from a lens ({models}) to "
            f"pinhole cameras of {size} pixels"
        )
    for flags, note in (
        (
            [photo.has_alpha for photo in photos],
            "have an alpha channel: transparent pixels are left out of training and scores",
        ),
        (
            [photo.extra > 0 for photo in photos],
            "have more channels than colours and alpha: the first are used as colours, the others ignored",
        ),
        (
            [photo.to_srgb is not None for photo in photos],
            "have colours in another profile than sRGB: they are converted to it",
        ),
        (
            [photo.has_unused_profile for photo in photos],
            "have a colour profile that is damaged or not one of RGB: it is left out",
        ),
        # by others, the size shows whether COLMAP has turned them
        (
            [
                photo.orientation in (2, 3, 4) or photo.orientation in QUARTER_TURNS and photo.width == photo.height
                for photo in photos
            ],
            "have an EXIF orientation and are read as they are stored: if the scene was "
            "reconstructed from turned photos, turn the pixels",
        ),
    ):
        if any(flags):
            yield f"{sum(flags)} of {len(photos)} photos {note}"


def _fitted(view: View, photo: Photo, factor: float, resized: Callable[[Lens, float, float], Lens]) -> View:
    """The view, its camera scaled by 1 / factor; InputError if its photo has another size."""
    # a photo that has its camera's size was reconstructed as it is stored, unless it is square
    turns = QUARTERS.get(photo.orientation, 0) if photo.width != photo.height else 0
    view = replace(view, transparent=photo.has_alpha, quarter_turns=turns if turns % 2 else 0)
    width, height = size = _stored_size(view)
    if (photo.width, photo.height) == size:
        return view
    if factor != 1 and max(abs(width / factor - photo.width), abs(height / factor - photo.height)) <= ROUNDING:
        if view.lens:
            lens = resized(view.lens, photo.width / width, photo.height / height)
            return replace(view, lens=lens, camera=view.camera.resized(lens.width, lens.height))
        return replace(view, camera=view.camera.resized(photo.width, photo.height))
    cure = "put back the one that was reconstructed; if all are smaller by one factor, name their folder with --images"
    if (photo.height, photo.width) == size and photo.orientation in QUARTER_TURNS:
        cure = (
            f"its EXIF orientation {photo.orientation} turns it, and the scene was "
            "reconstructed from the turned photo: turn the pixels of a copy (`mogrify "
            "-auto-orient`), and put that in its place"
        )
    elif factor != 1:
        cure = f"others there are {factor:.3g} times smaller than theirs; make all so"
    name = view.source if isinstance(view.source, Path) else view.name
    raise InputError(
        f"{name}: the photo has {photo.width}x{photo.height} pixels but its camera {width}x{height}; {cure}"
    )
