"""Reads CityGS's data sets (Liu et al. 2024): COLMAP folders train/ and val/ in one world frame."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.scenes.checks import checked_scene
from clsplat.io.scenes.colmap import read_model
from clsplat.io.scenes.sources import checked_photos
from clsplat.scene import Scene

TRAIN, VAL = "train", "val"
PHOTOS = ("images", "rgbs")
PER_VIEW = ("names", "rotations", "translations", "focals", "centres", "sizes", "lenses")


def has_parts(folder: Path) -> bool:
    """Whether the COLMAP models of a folder are in train/ and val/."""
    return (folder / TRAIN / "sparse").is_dir() and not (folder / "sparse").is_dir()


def read_citygs(folder: Path) -> Scene:
    """Read the scene of a folder whose train/ and val/ are COLMAP folders, and recentre it.

    The views of val/ are held out, and the points are those of train/. Photos are in images/ or
    rgbs/ of each part; the name of a view begins with its part.
    """
    if not (folder / VAL).is_dir():
        raise InputError(f"{folder / VAL}: missing beside {TRAIN}/; to train without held-out "
                         f"photos of their own give {folder / TRAIN}")
    parts = [_part(folder / name) for name in (TRAIN, VAL)]
    (train, _), (val, _) = parts
    arrays = {key: np.concatenate([train[key], val[key]]) for key in PER_VIEW}
    sources = [source for _, sources in parts for source in sources]
    scene = checked_photos(checked_scene(folder, folder.resolve().name, train | arrays, sources))
    return replace(scene, held_out=frozenset(map(str, val["names"]))).recentred()


def _part(folder: Path) -> tuple[dict[str, NDArray[Any]], list[Path]]:
    """The arrays of a part's model, with names below the scene's folder, and its photos."""
    _, arrays = read_model(folder, ("points3D",) if folder.name == VAL else ())
    photos = next((folder / name for name in PHOTOS if (folder / name).is_dir()),
                  folder / PHOTOS[0])
    # joined as text, so that a name with a leading slash stays below the folder
    sources = [Path(f"{photos}/{name}") for name in arrays["files"]]
    names = np.array([f"{folder.name}/{name}" for name in arrays["names"]])
    return arrays | {"names": names}, sources
