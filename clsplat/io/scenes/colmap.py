"""Reads a COLMAP reconstruction as a scene."""

import struct
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.regular import native, open_regular, read_regular
from clsplat.io.scenes.checks import checked_scene
from clsplat.io.scenes.colmap_format import PARTS
from clsplat.io.scenes.colmap_model import model_arrays
from clsplat.io.scenes.sources import IMAGES, checked_photos, photo_folder
from clsplat.scene import Scene


def read_colmap(folder: str | Path, images: str = "") -> Scene:
    """Read and recentre the scene of a folder with `images/` and a COLMAP model, binary or text.

    The model is searched in sparse/0, sparse, the folder itself and other sparse/N. Every photo
    must exist in its camera's size or, in another folder than images/, be smaller by one factor for
    all. Only their headers are read.

    Parameters
    ----------
    images : the folder of the photos, see `photo_folder`.
    """
    folder = Path(folder)
    model, arrays = read_model(folder)
    photos = photo_folder(folder, images)
    sources = [photos / native(name) for name in arrays["files"]]
    scene = checked_scene(model, folder.resolve().name, arrays, sources)
    scene = replace(scene, path=folder, notes=tuple(model_notes(folder, model)))
    may_be_smaller = bool(images) or photos.name != IMAGES
    return checked_photos(scene, photos if may_be_smaller else None).recentred()


def read_model(folder: Path, may_be_empty: Collection[str] = ()
               ) -> tuple[Path, dict[str, NDArray[Any]]]:
    """The folder of a scene folder's model, and its `model_arrays`, wherever the photos are."""
    model = find_model(folder)
    return model, model_arrays(model, may_be_empty)


def has_model(folder: Path) -> bool:
    """Whether a folder is meant to have a sparse model, where `find_model` looks for it."""
    return _is_model(folder) or (folder / "sparse").exists()


def find_model(folder: Path) -> Path:
    """Find the sparse model of a scene folder: sparse/0, sparse, the folder itself, or else the
    model with the most images below sparse/."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a scene folder with images and sparse/0")
    for model in (folder / "sparse" / "0", folder / "sparse", folder):
        if _is_model(model):
            return model
    others = _numbered_models(folder)
    if others:
        return max(others, key=registered)
    raise InputError(f"{folder}: no COLMAP model in sparse/0, sparse or the folder itself; of "
                     "photos, make a scene with `clsplat sfm` or let `clsplat train` do it "
                     "(docs/guide/photos.md), or give another folder")


def model_notes(folder: Path, model: Path) -> Iterator[str]:
    """Notes for the user about models of a scene folder that are not used."""
    others = [other for other in _numbered_models(folder) if other != model]
    largest = max(others, key=registered, default=None)
    if model.parent.name != "sparse" or largest is None and model.name == "0":
        return
    used = f"the model sparse/{model.name} is used, with {registered(model)} images"
    if largest is None:
        yield f"{used}: there is no sparse/0"
    elif registered(largest) > registered(model):
        yield (f"{used}, and sparse/{largest.name} has {registered(largest)}: COLMAP has split the "
               f"scene; to train the larger part, move it to sparse/0 of a folder of its own")
    elif model.name != "0":
        yield f"{used}: the largest of {len(others) + 1} below sparse/, where there is no sparse/0"


def _is_model(folder: Path) -> bool:
    return any((folder / f"{part}.{kind}").exists() for part in PARTS for kind in ("bin", "txt"))


def _numbered_models(folder: Path) -> list[Path]:
    """The models sparse/N of a scene folder, by number."""
    return sorted((path for path in (folder / "sparse").glob("*")
                   if path.name.isdecimal() and _is_model(path)), key=lambda path: int(path.name))


def registered(model: Path) -> int:
    """How many images a model claims to have; 0 if it is damaged."""
    try:
        if (model / "images.bin").exists():
            with open_regular(model / "images.bin") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        lines = read_regular(model / "images.txt").splitlines()
        # two lines an image, of which the second may be empty
        return -(-sum(not line.startswith(b"#") for line in lines) // 2)
    except (OSError, struct.error):
        return 0
