"""Reads a scene of any format, and computes its fingerprint."""

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from clsplat.errors import InputError, reason
from clsplat.io.georeference.files import placed
from clsplat.io.photos.masks import with_masks
from clsplat.io.runs.city import cropped_to_windows
from clsplat.io.scenes.colmap import has_model, has_parts, read_citygs, read_colmap
from clsplat.io.scenes.projects.metashape import find_metashape, read_metashape
from clsplat.io.scenes.projects.opensfm import find_opensfm, read_opensfm
from clsplat.io.scenes.projects.opf import find_opf, read_opf
from clsplat.io.scenes.transforms import has_transforms, read_transforms
from clsplat.scene import Scene

# the layouts of folders that are not COLMAP's: how each is recognised, and its reader
LAYOUTS = ((has_parts, read_citygs), (has_transforms, read_transforms))
# the projects of other programs: what finds their file, in a folder without a COLMAP model or as
# the path itself, and their reader
Project = tuple[Callable[[Path], Path | None], Callable[[Path, str], Scene]]
PROJECTS: tuple[Project, ...] = (
    (find_opensfm, read_opensfm), (find_metashape, read_metashape), (find_opf, read_opf))
# of entry points, by which other packages register readers: NAME = MODULE, with the functions
# find(path) and read(path, images) as in PROJECTS
GROUP = "clsplat.scenes"


def read_scene(path: str | os.PathLike[str], images: str = "") -> Scene:
    """Read a scene.

    Parameters
    ----------
    path : a folder with a COLMAP model, transforms.json, the layout of CityGS or a project of
        OpenSfM or ODM, Metashape or OPF; the file of such a project.
    images : the folder of its photos, relative to the scene's; "": images/, see `photo_folder`.
    """
    path = Path(path)
    if os.path.isdir(path):
        return placed(cropped_to_windows(with_masks(_read_folder(path, images), path), path), path)
    if not os.path.exists(path):
        raise InputError(f"{path}: no such scene; give a folder of photos, a folder with images "
                         "and sparse/0, or the file of a project")
    project = _read_project(path, images)
    if project is not None:
        return placed(with_masks(project, path.parent), path.parent)
    raise InputError(f"{path}: not a scene; give a folder with images and sparse/0, the file of a "
                     "project (Metashape's XML, OpenSfM's reconstruction.json, OPF)")


def is_scene(folder: Path) -> bool:
    """Whether a folder holds a scene of any layout, which need not be in order."""
    return (folder / "train" / "metadata").is_dir() or any(
        recognises(folder) for recognises, _ in LAYOUTS) or has_model(folder) or any(
        find(folder) for find, _ in _projects())


def _read_folder(path: Path, images: str) -> Scene:
    for recognises, read in LAYOUTS:
        if recognises(path):
            if images:
                raise InputError(f"--images {images}: {path} names its photos itself; leave the "
                                 "option out (it is for folders with a COLMAP model)")
            return read(path)
    if (path / "train" / "metadata").is_dir():
        raise InputError(f"{path}: a Mega-NeRF folder, whose metadata need PyTorch; convert them "
                         "with `python docs/examples/from_mega_nerf.py FOLDER`, then give it again")
    if not has_model(path):
        project = _read_project(path, images)
        if project is not None:
            return project
    return read_colmap(path, images)


def _read_project(path: Path, images: str) -> Scene | None:
    """The scene of another program's project, a folder or its file; None if it is none."""
    for find, read in _projects():
        file = find(path)
        if file is not None:
            return replace(read(file, images), path=path)
    return None


def _projects() -> Iterator[Project]:
    """Ours, then those of other packages, which are imported only if none of ours fits."""
    yield from PROJECTS
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            module = entry.load()
            yield module.find, module.read
        except (ImportError, AttributeError) as error:
            raise InputError(f"{entry.value}: cannot be loaded as a reader of scenes "
                             f"({reason(error)}); correct or uninstall its package") from error


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
