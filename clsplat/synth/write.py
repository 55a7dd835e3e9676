"""The scene folder of a synthetic city: images, COLMAP model and ground truth."""

import os
import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.atomic import PARTIAL
from clsplat.io.colmap_write import Tracks, write_colmap
from clsplat.io.folders import make_folder, remove_files
from clsplat.io.images import write_image
from clsplat.scene import View
from clsplat.synth import geometry
from clsplat.synth.cameras import survey
from clsplat.synth.layout import city as lay_out
from clsplat.synth.raycast import render
from clsplat.synth.texture import Texture
from clsplat.synth.tracks import observe

GEOMETRY = "geometry.json"
# what a call writes, and what it leaves where it is killed
WRITTEN = re.compile(r"(geometry\.json|images/\d+\.jpg|sparse/0/(cameras|images|points3D)\.bin)"
                     r"(\.part)?")


def synthesise(folder, blocks=(2, 2), views=32, width=320, height=240, seed=0, progress=None,
               overwrite=False):
    """Make a city, photograph it, and write the scene; the same arguments give the same bytes.

    folder gets images/NNN.jpg, sparse/0 (COLMAP, binary) and geometry.json; it appears whole, when
    all is written. blocks: along x and y;
    views: photos in all; width, height: pixels; progress: called as progress(done, views) after
    each photo. Returns (views, points, observations) written. Raises InputError for numbers out of
    range and for a folder that holds something else, or an older scene without `overwrite`.
    """
    _check(blocks, views, width, height, seed)
    folder = Path(folder)
    _check_room(folder, overwrite)
    city = lay_out(blocks, seed)
    cameras = survey(city, views, width, height, seed)
    points, point, view, pixels = observe(city, cameras, seed)
    if not len(points):
        raise InputError(f"{folder}: no point is seen in two of {views} views; ask for more views")

    partial = folder.with_name(folder.name + PARTIAL)
    _remove(partial)  # what a killed call left
    try:
        _write(partial, city, cameras, points, Tracks(point, view, pixels), progress)
    except BaseException:
        _remove(partial)
        raise
    _remove(folder)
    try:
        os.rename(partial, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot take the place of the earlier scene ({error.strerror});"
                         f" the new one is {partial}") from None
    return views, len(points), len(point)


def _write(folder, city, cameras, points, tracks, progress):
    """Write all files of a scene."""
    make_folder(folder / "images")
    geometry.save(city, folder / GEOMETRY)
    texture = Texture(city)
    colours = np.zeros((len(points), 3))
    digits = max(3, len(str(len(cameras) - 1)))
    photos = []
    for number, camera in enumerate(cameras):
        image = render(texture, camera)
        name = f"{number:0{digits}d}.jpg"
        photos.append(View(name, camera, folder / "images" / name))
        write_image(photos[-1].source, image)
        rows = tracks.views == number
        column, row = tracks.pixels[rows].astype(int).T
        colours[tracks.points[rows]] += image[row, column]
        if progress:
            progress(number + 1, len(cameras))
    colours /= np.bincount(tracks.points)[:, None]
    write_colmap(folder / "sparse" / "0", photos, points, np.round(colours).astype(np.uint8),
                 tracks)


def _check(blocks, views, width, height, seed):
    limits = (("blocks along x", blocks[0], 1, 64), ("blocks along y", blocks[1], 1, 64),
              ("views", views, 3, 100_000), ("width", width, 16, 16384),
              ("height", height, 16, 16384), ("seed", seed, 0, 2**32 - 1))
    for name, value, low, high in limits:
        if not low <= value <= high:
            raise InputError(f"synthetic city: {name} must be from {low} to {high}, got {value}")


def _check_room(folder, overwrite):
    """InputError where a scene cannot be written to `folder`."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder for the scene")
    if folder.is_dir() and any(folder.iterdir()):
        if not overwrite:
            raise InputError(f"{folder}: the folder is not empty; name another, or overwrite it")
        if not (folder / GEOMETRY).is_file():
            raise InputError(f"{folder}: holds no synthetic scene, so it is not overwritten; "
                             "name another folder")
        try:  # rather than after all photos are made
            probe = folder / (GEOMETRY + PARTIAL)
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror}); name another folder"
                             ) from None
        others = sorted(set(_files(folder)) - set(_written(folder)))
        if others:
            raise InputError(f"{others[0]}: is not of the synthetic scene, so nothing is "
                             "overwritten; move it, or name another folder")


def _files(folder):
    return [Path(path, name) for path, folders, names in os.walk(folder)
            for name in (*names, *folders) if not os.path.isdir(os.path.join(path, name))
            or os.path.islink(os.path.join(path, name))]


def _written(folder):
    """The files below `folder` that this module wrote: no links, which may lead anywhere."""
    return [path for path in _files(folder) if not path.is_symlink()
            and WRITTEN.fullmatch(path.relative_to(folder).as_posix())]


def _remove(folder):
    """Remove an earlier scene, and the folder if nothing else is in it."""
    if folder.is_dir():
        remove_files(_written(folder), folder)
        for path in ("images", "sparse/0", "sparse", "."):
            with suppress(OSError):
                os.rmdir(folder / path)
