"""Reads CityGS's data sets (Liu et al. 2024): COLMAP folders train/ and val/ in one world."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.checks import checked_scene
from clsplat.io.colmap import read_model
from clsplat.io.regular import native
from clsplat.io.sources import checked_photos

TRAIN, VAL = "train", "val"
PHOTOS = ("images", "rgbs")
PER_VIEW = ("names", "rotations", "translations", "focals", "centres", "sizes")


def has_parts(folder):
    """Whether the COLMAP models of a folder are in train/ and val/."""
    return (folder / TRAIN / "sparse").is_dir() and not (folder / "sparse").is_dir()


def read_citygs(folder):
    """The scene of a folder whose train/ and val/ are COLMAP folders, recentred; the views of val/
    are held out, the points are those of train/.

    Photos are in images/ or rgbs/ of each part; a view's name begins with its part. Whatever
    cannot be trained on raises InputError.
    """
    folder = Path(folder)
    if not (folder / VAL).is_dir():
        raise InputError(f"{folder / VAL}: missing beside {TRAIN}/; to train without held-out "
                         f"photos of their own give {folder / TRAIN}")
    models = [_part(folder / part) for part in (TRAIN, VAL)]
    arrays = {key: np.concatenate([model[key] for model in models]) for key in PER_VIEW}
    arrays |= {key: models[0][key] for key in ("points", "colours", "observations")}
    sources = [source for model in models for source in model["sources"]]
    scene = checked_photos(checked_scene(folder, folder.resolve().name, arrays, sources))
    return replace(scene, held_out=frozenset(map(str, models[1]["names"]))).recentred()


def _part(folder):
    """The arrays of a part's model, names below the scene's folder, and the sources of its photos.
    """
    model, arrays = read_model(folder, ("points3D",) if folder.name == VAL else ())
    if len(arrays["distorted"]):
        raise InputError(f"{model}: camera model {', '.join(arrays['distorted'])} has lens "
                         "distortion and clsplat wants PINHOLE; undistort both parts with "
                         "`colmap image_undistorter`")
    photos = next((folder / name for name in PHOTOS if (folder / name).is_dir()),
                  folder / PHOTOS[0])
    # no name leads out of the folder, as one that begins with a slash would after a Path's slash
    sources = [Path(f"{photos}/{native(name)}") for name in arrays["names"]]
    names = np.array([f"{folder.name}/{name}" for name in arrays["names"]])
    return {**arrays, "names": names, "sources": sources}
