"""Reads a scene of any format, and computes its fingerprint."""

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from clsplat.errors import InputError, reason
from clsplat.io.georeference.files import placed
from clsplat.io.photos.masks import with_masks
from clsplat.io.runs.city import cropped_to_windows
from clsplat.scene import Scene

# what finds the file or folder to read, in a folder or as the path itself, and its reader
Reader = tuple[Callable[[Path], Path | None], Callable[[Path, str], Scene]]
# ours in the order in which they are asked: NAME -> MODULE, with find_NAME and read_NAME
READERS = {
    "citygs": "colmap",
    "colmap": "colmap",
    "transforms": "transforms",
    "opensfm": "projects.opensfm",
    "metashape": "projects.metashape",
}
NAME_PHOTOS = ("read_citygs", "read_transforms")  # these scenes say where theirs are
# of entry points, by which other packages register readers: NAME = MODULE, with the functions
# find(path) and read(path, images) as in READERS
GROUP = "clsplat.scenes"


def read_scene(path: str | os.PathLike[str], images: str = "") -> Scene:
    """Read a scene.

    Parameters
    ----------
    path : a folder with a COLMAP model, transforms.json, the layout of CityGS or a project of
        OpenSfM or ODM or Metashape; the file of such a project.
    images : the folder of its photos, relative to the scene's; "": images/, see `photo_folder`.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise InputError(
            f"{path}: no such scene; give a folder of photos, a folder with images "
            "and sparse/0, or the file of a project"
        )
    if _is_mega_nerf(path):
        raise InputError(
            f"{path}: a Mega-NeRF folder, whose metadata need PyTorch; convert them "
            "with `python docs/examples/from_mega_nerf.py FOLDER`, then give it again"
        )
    for find, read in _readers():
        file = find(path)
        if file is None:
            continue
        if images and getattr(read, "__name__", "") in NAME_PHOTOS:
            raise InputError(
                f"--images {images}: {path} names its photos itself; leave the "
                "option out (it is for folders with a COLMAP model)"
            )
        folder = path if path.is_dir() else path.parent
        scene = with_masks(replace(read(file, images), path=path), folder)
        return placed(cropped_to_windows(scene, folder), folder)
    raise InputError(
        f"{path}: not a scene: no COLMAP model in sparse/0, sparse or the folder "
        "itself, and no project; of photos, make a scene with `clsplat sfm` or let "
        "`clsplat train` do it (docs/guide/photos.md), or give another folder"
    )


def is_scene(folder: Path) -> bool:
    """Whether a folder holds a scene of any layout, which need not be in order."""
    return _is_mega_nerf(folder) or any(find(folder) for find, _ in _readers())


def _is_mega_nerf(path: Path) -> bool:
    """Whether a folder is one that its example has not converted."""
    return (path / "train" / "metadata").is_dir() and _ours("transforms")[0](path) is None


def _ours(name: str) -> Reader:
    """A reader of READERS, whose module is imported here."""
    module = import_module(f"clsplat.io.scenes.{READERS[name]}")
    return getattr(module, f"find_{name}"), getattr(module, f"read_{name}")


def _readers() -> Iterator[Reader]:
    """Ours, then those of other packages; each is imported only if none before it fits."""
    yield from map(_ours, READERS)
    from importlib.metadata import entry_points

    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            module = entry.load()
            yield module.find, module.read
        except (ImportError, AttributeError) as error:
            raise InputError(
                f"{entry.value}: cannot be loaded as a reader of scenes "
                f"({reason(error)}); correct or uninstall its package"
            ) from error


def fingerprint(scene: Scene) -> str:
    """SHA-256 of a scene's names, cameras, points and offset, by which a resumed run recognises it.

    Photos are left out, since reading them all would take too long.
    """

    def stored(values: ArrayLike) -> bytes:
        return np.asarray(values, "<f8").tobytes()

    digest = hashlib.sha256()
    for view in scene.views:
        camera = view.camera
        name = view.name.encode()
        digest.update(len(name).to_bytes(8, "little") + name)
        digest.update(stored((camera.width, camera.height, *camera.focal, *camera.centre)))
        digest.update(stored(camera.rotation) + stored(camera.translation))
    digest.update(stored(scene.points) + stored(scene.offset))
    digest.update(np.ascontiguousarray(scene.colours, np.uint8).tobytes())
    return digest.hexdigest()
