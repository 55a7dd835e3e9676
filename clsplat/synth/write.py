"""The scene folder of a synthetic city: images, COLMAP model and ground truth."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.atomic import PARTIAL
from clsplat.io.folders import make_folder
from clsplat.io.photos.images import write_image
from clsplat.io.scenes.colmap_files import Tracks, write_colmap
from clsplat.scene import View
from clsplat.synth import geometry
from clsplat.synth.cameras import survey
from clsplat.synth.geometry import City
from clsplat.synth.layout import city as lay_out
from clsplat.synth.raycast import render
from clsplat.synth.texture import Texture
from clsplat.synth.tracks import observe

GEOMETRY = "geometry.json"


def synthesise(folder: str | os.PathLike[str], blocks: tuple[int, int] = (2, 2), views: int = 32,
               width: int = 320, height: int = 240, seed: int = 0,
               progress: Callable[[int, int], object] | None = None) -> tuple[int, int, int]:
    """Make a city, render its photos, and write the scene; the same arguments give the same bytes.

    Parameters
    ----------
    folder : gets images/NNN.jpg, sparse/0 (COLMAP, binary) and geometry.json; it is created as a
        whole when everything is written.
    blocks : along x and y.
    views : the number of photos.
    width : of a photo, pixels.
    height : of a photo, pixels.
    seed : of everything random.
    progress : called with the numbers of finished photos and of all photos after each photo.

    Returns
    -------
    The numbers of views, points and observations.

    Raises
    ------
    InputError : a number is out of range, or the folder is not empty.
    """
    _check(blocks, views, width, height, seed)
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder for the scene")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: the folder is not empty; name another, or remove it")
    city = lay_out(blocks, seed)
    cameras = survey(city, views, width, height, seed)
    points, point, view, pixels = observe(city, cameras, seed)
    if not len(points):
        raise InputError(f"{folder}: no two of {views} views see the same point; use more views")
    partial = folder.with_name(folder.name + PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)  # the rest of a call that was killed
    try:
        _write(partial, city, cameras, points, Tracks(point, view, pixels), progress)
        if folder.is_dir():
            folder.rmdir()
        os.rename(partial, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); name another folder"
                         ) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return views, len(points), len(point)


def _write(folder: Path, city: City, cameras: Sequence[Camera], points: NDArray[np.float64],
           tracks: Tracks, progress: Callable[[int, int], object] | None) -> None:
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
        path = folder / "images" / name
        photos.append(View(name, camera, path))
        write_image(path, image)
        rows = tracks.views == number
        column, row = tracks.pixels[rows].astype(int).T
        colours[tracks.points[rows]] += image[row, column]
        if progress:
            progress(number + 1, len(cameras))
    colours /= np.bincount(tracks.points)[:, None]
    write_colmap(folder / "sparse" / "0", photos, points, np.round(colours).astype(np.uint8),
                 tracks)


def _check(blocks: tuple[int, int], views: int, width: int, height: int, seed: int) -> None:
    limits = (("blocks along x", blocks[0], 1, 64), ("blocks along y", blocks[1], 1, 64),
              ("views", views, 3, 100_000), ("width", width, 16, 16384),
              ("height", height, 16, 16384), ("seed", seed, 0, 2**32 - 1))
    for name, value, low, high in limits:
        if not low <= value <= high:
            raise InputError(f"synthetic city: {name} must be from {low} to {high}, got {value}")
