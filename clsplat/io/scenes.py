"""Reads a scene of any format, and computes its fingerprint."""

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from clsplat.errors import InputError
from clsplat.io.city import PACKED, attached
from clsplat.io.citygs import has_parts, read_citygs
from clsplat.io.colmap import read_colmap
from clsplat.io.packed import read_packed
from clsplat.io.transforms import has_transforms, read_transforms
from clsplat.scene import Scene

# the layouts of folders that are not COLMAP's: how each is recognised, and its reader
LAYOUTS = ((has_parts, read_citygs), (has_transforms, read_transforms))


def read_scene(path: str | os.PathLike[str], images: str = "") -> Scene:
    """Read a scene.

    Parameters
    ----------
    path : a folder with a COLMAP model, transforms.json or the layout of CityGS, or a packed .npz.
    images : the folder of its photos, relative to the scene's; "": images/, see `photo_folder`.
    """
    path = Path(path)
    if os.path.isdir(path):
        return attached(_read_folder(path, images), path)
    if not os.path.exists(path):
        raise InputError(f"{path}: no such scene; give a folder with images and sparse/0, or a "
                         "packed .npz")
    if path.suffix == ".npz":
        _no_images(path, images, "a packed scene")
        return read_packed(path)
    raise InputError(f"{path}: not a scene; give a folder with images and sparse/0, or a packed "
                     ".npz")


def _read_folder(path: Path, images: str) -> Scene:
    packed = path / PACKED
    if packed.is_file():  # a block of a packed scene
        _no_images(path, images, "a packed scene")
        return replace(read_packed(packed), name=path.resolve().name, path=path)
    for recognises, read in LAYOUTS:
        if recognises(path):
            _no_images(path, images, "a scene that names its photos itself")
            return read(path)
    if (path / "train" / "metadata").is_dir():
        raise InputError(f"{path}: a Mega-NeRF folder, whose metadata need PyTorch; convert them "
                         "with `python docs/examples/from_mega_nerf.py FOLDER`, then give it again")
    return read_colmap(path, images)


def _no_images(path: Path, images: str, kind: str) -> None:
    if images:
        raise InputError(f"--images {images}: {path} is {kind}; leave the option out (it is for "
                         "folders with a COLMAP model)")


def fingerprint(scene: Scene) -> str:
    """SHA-256 of a scene's names, cameras, points and offset, by which a resumed run recognises it.

    Photos are left out, since reading them all would take too long.
    """
    digest = hashlib.sha256()
    for view in scene.views:
        camera = view.camera
        name = view.name.encode()
        digest.update(len(name).to_bytes(8, "little") + name)
        digest.update(_bytes((camera.width, camera.height, *camera.focal, *camera.centre)))
        digest.update(_bytes(camera.rotation) + _bytes(camera.translation))
    digest.update(_bytes(scene.points) + _bytes(scene.offset))
    digest.update(np.ascontiguousarray(scene.colours, np.uint8).tobytes())
    return digest.hexdigest()


def _bytes(values: ArrayLike) -> bytes:
    return np.asarray(values, "<f8").tobytes()
