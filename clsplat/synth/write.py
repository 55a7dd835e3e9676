"""The scene folder of a synthetic city: images, COLMAP model and ground truth."""

import shutil
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.colmap_write import Tracks, write_colmap
from clsplat.io.images import write_image
from clsplat.scene import View
from clsplat.synth import geometry
from clsplat.synth.cameras import survey
from clsplat.synth.layout import city as lay_out
from clsplat.synth.raycast import render
from clsplat.synth.texture import Texture
from clsplat.synth.tracks import observe

GEOMETRY = "geometry.json"


def synthesise(folder, blocks=(2, 2), views=32, width=320, height=240, seed=0, progress=None,
               overwrite=False):
    """Make a city, photograph it, and write the scene; the same arguments give the same bytes.

    folder gets images/NNN.jpg, sparse/0 (COLMAP, binary) and geometry.json. blocks: along x and y;
    views: photos in all; width, height: pixels; progress: called as progress(done, views) after
    each photo. Returns (views, points, observations) written. Raises InputError for numbers out of
    range and for a folder that holds something else, or an older scene without `overwrite`.
    """
    _check(blocks, views, width, height, seed)
    folder = Path(folder)
    _make_room(folder, overwrite)
    city = lay_out(blocks, seed)
    cameras = survey(city, views, width, height, seed)
    points, point, view, pixels = observe(city, cameras, seed)
    if not len(points):
        raise InputError(f"{folder}: no point is seen in two of {views} views; ask for more views")

    geometry.save(city, folder / GEOMETRY)
    texture = Texture(city)
    colours = np.zeros((len(points), 3))
    digits = max(3, len(str(views - 1)))
    photos = []
    for number, camera in enumerate(cameras):
        image = render(texture, camera)
        photos.append(View(f"{number:0{digits}d}.jpg", camera,
                           folder / "images" / f"{number:0{digits}d}.jpg"))
        write_image(photos[-1].source, image)
        rows = view == number
        column, row = pixels[rows].astype(int).T
        colours[point[rows]] += image[row, column]
        if progress:
            progress(number + 1, views)
    colours /= np.bincount(point)[:, None]
    write_colmap(folder / "sparse" / "0", photos, points, np.round(colours).astype(np.uint8),
                 Tracks(point, view, pixels))
    return len(photos), len(points), len(point)


def _check(blocks, views, width, height, seed):
    limits = (("blocks along x", blocks[0], 1, 64), ("blocks along y", blocks[1], 1, 64),
              ("views", views, 3, 100_000), ("width", width, 16, 16384),
              ("height", height, 16, 16384), ("seed", seed, 0, 2**32 - 1))
    for name, value, low, high in limits:
        if not low <= value <= high:
            raise InputError(f"synthetic city: {name} must be from {low} to {high}, got {value}")


def _make_room(folder, overwrite):
    """Leave `folder` with an empty images/; only what an earlier call wrote is ever removed."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder for the scene")
    if folder.is_dir() and any(folder.iterdir()):
        if not overwrite:
            raise InputError(f"{folder}: the folder is not empty; name another, or overwrite it")
        if not (folder / GEOMETRY).is_file():
            raise InputError(f"{folder}: holds no synthetic scene, so it is not overwritten; "
                             "name another folder")
        for name in ("images", "sparse"):
            shutil.rmtree(folder / name, ignore_errors=True)
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); name another") from None
