"""Make a city scene with known geometry: photos, a COLMAP model and the true surfaces.

    python -m tools.synth FOLDER [--blocks 2x2] [--views 32] [--size 320x240] [--seed 0]
    python -m tools.synth FOLDER --large --views 1600 --size 1152x864 [--drift 0.15]

The second form makes a survey like a real one: a city as large as the photos cover with 76 %
overlap, in detail as fine as their pixels, with GPS, drawn on an OpenCL device.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from clsplat.device import choose_device
from clsplat.errors import ClsplatError, InputError
from clsplat.io.folders import make_folder, new_folder
from clsplat.io.photos.images import write_image
from clsplat.io.scenes.colmap_files import write_colmap
from clsplat.scene import View
from tools.synth.city import UNIT_METRES, geometry_json, lay_out
from tools.synth.large import ALTITUDE_METRES, POINTS_PER_VIEW, synthesise_large
from tools.synth.raycast import render
from tools.synth.survey import focal_of, observe, survey
from tools.synth.texture import Texture


def synthesise(folder, blocks=(2, 2), views=32, size=(320, 240), seed=0):
    """Make a city, render its photos and write the scene; the same arguments give the same bytes.

    The folder gets images/NNN.jpg, sparse/0 (COLMAP, binary) and geometry.json. Returns the numbers
    of points and of observations.
    """
    check(blocks, views, size, seed)
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
        write_colmap(
            folder / "sparse" / "0",
            photos,
            points,
            np.round(colours).astype(np.uint8),
            np.column_stack([point, view]),
            pixels,
        )
    return len(points), len(point)


def check(blocks, views, size, seed, pixel=0.1, points=1, drift=0.0):
    """InputError for a number with which no scene can be made."""
    limits = (
        ("blocks along x", blocks[0], 1, 64),
        ("blocks along y", blocks[1], 1, 64),
        ("views", views, 3, 100_000),
        ("width", size[0], 16, 16384),
        ("height", size[1], 16, 16384),
        ("seed", seed, 0, 2**32 - 1),
        ("pixel", pixel, 0.001, 1),
        ("points", points, 1, 50_000_000),
        ("drift", drift, 0, 1),
    )
    for name, value, low, high in limits:
        if not low <= value <= high:
            raise InputError(f"made city: {name} must be from {low} to {high}, got {value}")


def pair(text):
    """Two whole numbers from a text such as 320x240."""
    first, second = map(int, text.split("x"))
    return first, second


def main(words):
    """Make the scene that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument(
        "--blocks", type=pair, help="city blocks along x and y (2x2; --large: as many as the photos cover)"
    )
    parser.add_argument("--views", type=int, default=32, help="number of photos")
    parser.add_argument("--size", type=pair, default=(320, 240), help="of a photo, pixels")
    parser.add_argument("--seed", type=int, default=0)
    large = parser.add_argument_group("of a survey like a real one")
    large.add_argument("--large", action="store_true", help="make one")
    large.add_argument(
        "--pixel",
        type=float,
        help="world units on the ground of a pixel of a nadir photo (as from "
        f"{ALTITUDE_METRES:g} m; a unit is {UNIT_METRES:g} m)",
    )
    large.add_argument("--points", type=int, help=f"the most sparse points ({POINTS_PER_VIEW} a photo)")
    large.add_argument(
        "--drift", type=float, default=0.0, help="of exposure over the flight, 0.15 for 15 %% up and down"
    )
    large.add_argument("--device", default="auto", help="as of clsplat")
    given = parser.parse_args(words)
    if not given.large and (given.pixel or given.points or given.drift):
        parser.error("--pixel, --points and --drift need --large")
    try:
        print(f"{given.folder}: {(large_scene if given.large else small_scene)(given)}")
    except ClsplatError as error:
        parser.exit(2, f"error: {error}\n")


def small_scene(given):
    """Make the scene; returns what it has, in words."""
    points, observations = synthesise(given.folder, given.blocks or (2, 2), given.views, given.size, given.seed)
    return f"{given.views} views, {points:,} points, {observations:,} observations"


def large_scene(given):
    """Make the survey; returns what it has, in words."""
    pixel = given.pixel or ALTITUDE_METRES / UNIT_METRES / focal_of(given.size[0])
    check(given.blocks or (1, 1), given.views, given.size, given.seed, pixel, given.points or 1, given.drift)
    made = synthesise_large(
        given.folder,
        choose_device(given.device),
        given.views,
        given.size,
        pixel,
        given.blocks,
        given.points,
        given.drift,
        given.seed,
    )
    return (
        f"{given.views} views of {made.blocks[0]}x{made.blocks[1]} blocks, {made.solids:,} "
        f"solids; pixel {made.pixel:.3f} units, overlap {made.overlap:.0%}; {made.points:,} "
        f"points, {made.observations:,} observations"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
