"""Reads a scene, whatever its format, and names its content."""

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.city import PACKED, attached
from clsplat.io.citygs import has_parts, read_citygs
from clsplat.io.colmap import read_colmap
from clsplat.io.packed import read_packed
from clsplat.io.transforms import has_transforms, read_transforms
from clsplat.scene import Scene

# how a folder that is no COLMAP folder is told, and its reader
LAYOUTS = ((has_parts, read_citygs), (has_transforms, read_transforms))


def read_scene(path, images="") -> Scene:
    """The Scene of a folder with a COLMAP model, transforms.json, or the layout of CityGS, or of a
    packed .npz; else InputError.

    images: the folder of its photos, from the scene's folder; "": images/, see `photo_folder`.
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


def _read_folder(path, images):
    packed = path / PACKED
    if packed.is_file():  # a block of a packed scene
        _no_images(path, images, "a packed scene")
        return replace(read_packed(packed), name=path.resolve().name, path=path)
    for found, read in LAYOUTS:
        if found(path):
            _no_images(path, images, "a scene that names its photos itself")
            return read(path)
    if (path / "train" / "metadata").is_dir():
        raise InputError(f"{path}: a Mega-NeRF folder, whose metadata need PyTorch; describe it "
                         "with `python docs/examples/from_mega_nerf.py FOLDER`, then give it again")
    return read_colmap(path, images)


def _no_images(path, images, what):
    if images:
        raise InputError(f"--images {images}: {path} is {what}; leave it out (it is for folders "
                         "with a COLMAP model)")


def fingerprint(scene):
    """SHA-256, hex, of a scene's names, cameras, points and offset: what a resumed run must meet.

    Photos are left out: reading them all would cost more than it tells.
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


def _bytes(values):
    return np.asarray(values, "<f8").tobytes()
