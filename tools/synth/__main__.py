"""Make a city scene with known geometry: photos, a COLMAP model and the true surfaces.

    python -m tools.synth FOLDER [--blocks 2x2] [--views 32] [--size 320x240] [--seed 0]
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.folders import make_folder, new_folder
from clsplat.io.photos.images import write_image
from clsplat.io.scenes.colmap_files import write_colmap
from clsplat.scene import View
from tools.synth.city import geometry_json, lay_out
from tools.synth.raycast import render
from tools.synth.survey import observe, survey
from tools.synth.texture import Texture


def synthesise(folder, blocks=(2, 2), views=32, size=(320, 240), seed=0):
    """Make a city, render its photos and write the scene; the same arguments give the same bytes.

    The folder gets images/NNN.jpg, sparse/0 (COLMAP, binary) and geometry.json. Returns the numbers
    of points and of observations.
    """
    limits = (("blocks along x", blocks[0], 1, 64), ("blocks along y", blocks[1], 1, 64),
              ("views", views, 3, 100_000), ("width", size[0], 16, 16384),
              ("height", size[1], 16, 16384), ("seed", seed, 0, 2**32 - 1))
    for name, value, low, high in limits:
        if not low <= value <= high:
            raise InputError(f"made city: {name} must be from {low} to {high}, got {value}")
    city = lay_out(blocks, seed)
    cameras = survey(city, views, *size, seed)
    points, point, view, pixels = observe(city, cameras, seed)
    if not len(points):
        raise InputError(f"{folder}: no two of {views} views see the same point; use more views")
    texture = Texture(city)
    colours = np.zeros((len(points), 3))
    digits = max(3, len(str(views - 1)))
    photos = []
    with new_folder(Path(folder)) as folder:
        make_folder(folder / "images")
        (folder / "geometry.json").write_text(geometry_json(city), "utf-8", newline="\n")
        for number, camera in enumerate(cameras):
            image = render(texture, camera)
            name = f"{number:0{digits}d}.jpg"
            photos.append(View(name, camera, folder / "images" / name))
            write_image(photos[-1].source, image)
            rows = view == number
            column, row = pixels[rows].astype(int).T
            colours[point[rows]] += image[row, column]
        colours /= np.bincount(point)[:, None]
        write_colmap(folder / "sparse" / "0", photos, points, np.round(colours).astype(np.uint8),
                     np.column_stack([point, view]), pixels)
    return len(points), len(point)


def pair(text):
    """Two whole numbers from a text such as 320x240."""
    first, second = map(int, text.split("x"))
    return first, second


def main(words):
    """Make the scene that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("--blocks", type=pair, default=(2, 2), help="city blocks along x and y")
    parser.add_argument("--views", type=int, default=32, help="number of photos")
    parser.add_argument("--size", type=pair, default=(320, 240), help="of a photo, pixels")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(words)
    try:
        points, observations = synthesise(**vars(given))
    except InputError as error:
        parser.exit(2, f"error: {error}\n")
    print(f"{given.folder}: {given.views} views, {points:,} points, {observations:,} observations")


if __name__ == "__main__":
    main(sys.argv[1:])
