"""The photos of a scene: in which folder they are, whether they fit their cameras, what they are.

Headers are read here, not pixels.
"""

import os
import re
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.photo import opened
from clsplat.io.reason import LONGEST

IMAGES, SMALLER = "images", re.compile(r"images_(\d+)")  # as Mip-NeRF 360 has them
ROUNDING = 1.5  # pixels that a smaller photo may differ from its share of the camera
QUARTER_TURNS = (5, 6, 7, 8)  # EXIF orientations that swap width and height


def photo_folder(folder: Path, images: str = "") -> Path:
    """Where the photos of a scene are: `images`, from the scene's folder, or else images/, or else
    the largest that there are of images_2/, images_4/, ..."""
    try:
        images.encode()
    except UnicodeEncodeError:
        raise InputError(f"--images {images!a}: its name is not UTF-8; rename it") from None
    numbered = sorted((path for path in folder.glob("images_*") if SMALLER.fullmatch(path.name)
                       and path.is_dir()), key=lambda path: int(path.name.rpartition("_")[2]))
    if images:
        if os.path.isdir(folder / images):
            return folder / images
        there = [path.name for path in (folder / IMAGES, *numbered) if path.is_dir()]
        raise InputError(f"--images {images}: {folder} has no such folder; "
                         f"there is {', '.join(there) or 'none with photos'}")
    if numbered and not (folder / IMAGES).is_dir():
        return numbered[0]
    return folder / IMAGES


def checked_photos(scene, smaller: Path | None = None):
    """The scene with notes on its photos, once every photo is there in its camera's size.

    smaller: a folder whose photos may all be smaller than their cameras by one factor; the cameras
    are then scaled. InputError for a photo that is missing, cannot be read or does not fit.
    """
    missing = [view for view in scene.views
               if isinstance(view.source, Path) and not os.path.exists(view.source)]
    if missing:
        raise InputError(f"{str(missing[0].source)[:LONGEST]}: no such image ({len(missing)} of "
                         f"{len(scene.views)} images of the model are missing); "
                         f"{_where_else(missing[0].source)}")
    photos = []
    for view in scene.views:
        with opened(view.source) as photo:
            photos.append(photo)
    factor = _factor(scene.views, photos) if smaller else 1.0
    notes = [*scene.notes, *_colour_notes(photos), *_turn_notes(photos)]
    if smaller and smaller.name != IMAGES or factor != 1:
        notes.insert(0, _factor_note(smaller, factor))
    views = tuple(_fitted(view, photo, factor) for view, photo in zip(scene.views, photos))
    return replace(scene, views=views, notes=tuple(notes))


def _where_else(path):
    """What to do about a photo that is missing, by what its folder holds."""
    def same(name):
        return unicodedata.normalize("NFC", name).casefold()

    try:
        names = sorted(os.listdir(path.parent))
    except OSError:
        names = []
    for name in names:
        if same(name) == same(path.name):
            return (f"{name!a} is there, which differs in letter case or in the form of its "
                    "characters: rename it")
    for name in names:
        if same(Path(name).stem) == same(path.stem):
            return f"{name!a} is there, with another suffix: convert or rename it"
    return "put the photos there, or name their folder with --images"


def _factor(views, photos):
    """How many times smaller than their cameras all photos are; 1 where they are as large."""
    factor = float(np.median([view.camera.width / photo.width
                              for view, photo in zip(views, photos)]))
    for view, photo in zip(views, photos):
        camera = view.camera
        if max(abs(camera.width / factor - photo.width),
               abs(camera.height / factor - photo.height)) > ROUNDING:
            raise InputError(
                f"{photo.name}: the photo has {photo.width}x{photo.height} pixels but its camera "
                f"{camera.width}x{camera.height}, and other photos there are {factor:.3g} times "
                "smaller than theirs; make all of one folder smaller by one factor")
    same = all((view.camera.width, view.camera.height) == (photo.width, photo.height)
               for view, photo in zip(views, photos))
    return 1.0 if same else factor


def _factor_note(folder, factor):
    size = ("as large as the model's cameras" if factor == 1 else
            f"{factor:.3g} times smaller than the model's cameras, which are scaled to fit")
    return f"photos are those of {folder.name}/, {size}"


def _colour_notes(photos):
    """Lines about samples that are converted or left out."""
    count = len(photos)
    linear = sum(photo.linear for photo in photos)
    if linear:
        yield (f"{linear} of {count} photos hold linear light (EXR, HDR or floating point): they "
               "are brought to sRGB, and what is brighter than 1 is cut off")
    alpha = sum(photo.has_alpha for photo in photos)
    if alpha:
        yield (f"{alpha} of {count} photos have an alpha channel, which is ignored: what it hides "
               "is trained on too")
    extra = sum(photo.extra > 0 for photo in photos)
    if extra:
        yield (f"{extra} of {count} photos have more channels than colours and alpha: the first "
               "are taken as colours, the others ignored")


def _turn_notes(photos):
    """A line about photos that EXIF turns, where their size cannot tell whether COLMAP did."""
    turned = sum(photo.orientation in (2, 3, 4) or photo.orientation in QUARTER_TURNS
                 and photo.width == photo.height for photo in photos)
    if turned:
        yield (f"{turned} of {len(photos)} photos have an EXIF orientation and are read as they "
               "are stored: if the scene was reconstructed from turned photos, turn the pixels")


def _fitted(view, photo, factor):
    """The view, its camera scaled by 1 / factor; InputError where its photo has another size."""
    width, height, camera = photo.width, photo.height, view.camera
    if (width, height) == (camera.width, camera.height):
        return view
    if factor != 1:
        return replace(view, camera=camera.resized(width, height))
    name = view.source if isinstance(view.source, Path) else view.name
    scale_x, scale_y = width / camera.width, height / camera.height
    # rounding of the shorter side may move the ratio by up to a pixel
    if abs(scale_x - scale_y) <= 1.0 / min(camera.width, camera.height):
        why = ("it was rescaled: put the original back and use --downscale to train on smaller "
               "ones; where all were, name their folder with --images")
    elif (width, height) == (camera.height, camera.width):
        why = "it was rotated: put the original back, as it was when the scene was reconstructed"
        if photo.orientation in QUARTER_TURNS:
            why = (f"its EXIF orientation {photo.orientation} turns it, and the scene was "
                   "reconstructed from the turned photo: turn the pixels of a copy (`mogrify "
                   "-auto-orient`), and put that in its place")
    else:
        why = "it is another photo or was cropped: put back the one that was reconstructed"
    raise InputError(f"{name}: the photo has {width}x{height} pixels but its camera "
                     f"{camera.width}x{camera.height}; {why}")
