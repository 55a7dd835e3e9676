"""A survey of the size of a real one: a large city in fine detail, drawn on an OpenCL device."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device import Device, Reading
from clsplat.errors import InputError
from clsplat.io.ahead import called_ahead
from clsplat.io.folders import make_folder, new_folder
from clsplat.io.georeference.crs import WGS84, conversion
from clsplat.io.photos.images import JPEG_QUALITY, Attributes, write_image
from clsplat.io.scenes.colmap_files import write_colmap
from clsplat.scene import View
from tools.synth.city import UNIT_METRES, geometry_json, lay_out
from tools.synth.draw import DeviceCity
from tools.synth.sparse import observe_on
from tools.synth.survey import blocks_for, fly, gains, overlap_of
from tools.synth.texture import Texture

POINTS_PER_VIEW = 1100
ALTITUDE_METRES = 120.0  # from which the pixel follows if none is asked for
CRS, ORIGIN = "EPSG:32632", (500_000.0, 5_300_000.0, 450.0)  # metres, of the city's middle
GPS_NOISE = (1.0, 1.0, 2.0)  # metres, standard deviations to the east, to the north and up


class Survey(NamedTuple):
    """What `synthesise_large` made."""

    blocks: tuple[int, int]  # of the city along x and y
    pixel: float  # world units on the ground of a pixel of a nadir photo
    overlap: float  # of neighbouring nadir photos on the ground, a share of their sides
    # how many there are
    solids: int
    points: int
    observations: int


def synthesise_large(
    folder: str | Path,
    device: Device,
    views: int,
    size: tuple[int, int],
    pixel: float,
    blocks: tuple[int, int] | None = None,
    points: int | None = None,
    drift: float = 0.0,
    seed: int = 0,
) -> Survey:
    """Make a large city, draw its photos and write the scene, with GPS in the photos; the same
    arguments give the same bytes on one device.

    Parameters
    ----------
    folder : is created; gets images/NNN.jpg, sparse/0 (COLMAP, binary) and geometry.json.
    device : an open device.
    views : the number of photos.
    size : (width, height) of a photo, pixels.
    pixel : world units on the ground of a pixel of a nadir photo.
    blocks : of the city along x and y; None: as many as the photos cover with the usual overlap.
    points : the most sparse points; None: in proportion to the photos.
    drift : of the exposure over the flight, 0.15 for 15 % up and down.
    seed : of all randomness.
    """
    side = blocks_for(views, *size, pixel)
    city = lay_out(blocks or (side, side), seed, small=True)
    cameras = fly(city, views, *size, pixel, seed)
    light = gains(views, drift, seed)
    drawn = DeviceCity(device, Texture(city, pixel))
    sparse = observe_on(drawn, city, cameras, points or POINTS_PER_VIEW * views, seed)
    if not len(sparse.points):
        raise InputError(f"{folder}: no two of {views} views see the same point; use more views")
    digits = max(3, len(str(views - 1)))
    with new_folder(Path(folder)) as folder:
        make_folder(folder / "images")
        (folder / "geometry.json").write_text(geometry_json(city, light if drift else None), "utf-8", newline="\n")
        names = [f"{number:0{digits}d}.jpg" for number in range(views)]
        photos = [View(name, camera, folder / "images" / name) for name, camera in zip(names, cameras)]
        _write_photos(drawn, folder / "images", photos, light, _positions(cameras, seed))
        write_colmap(
            folder / "sparse" / "0",
            photos,
            sparse.points,
            sparse.colours,
            np.column_stack([sparse.point, sparse.view]),
            sparse.pixels,
        )
    return Survey(
        city.blocks,
        pixel,
        overlap_of(city, views, *size, pixel),
        len(city.boxes) + len(city.spheres),
        len(sparse.points),
        len(sparse.point),
    )


def _write_photos(
    drawn: DeviceCity, folder: Path, photos: list[View], light: NDArray[np.float64], positions: list[Attributes]
) -> None:
    """Draw photos one after the other, while threads encode those before."""

    def drawing() -> Iterator[tuple[View, Reading, Attributes]]:
        for photo, factors, position in zip(photos, light, positions):
            yield photo, drawn.photo(photo.camera, factors), position

    def write(photo: View, image: Reading, position: Attributes) -> None:
        write_image(folder / photo.name, image.values(), JPEG_QUALITY, position)

    threads = os.cpu_count() or 1
    for _ in called_ahead(write, drawing(), threads, 2 * threads):
        pass


def _positions(cameras: list[Camera], seed: int) -> list[Attributes]:
    """The positions of cameras as GPS with noise, attributes of EXIF for each photo."""
    rng = np.random.default_rng([seed, 7])
    metres = np.array([camera.position for camera in cameras]) * UNIT_METRES + ORIGIN
    metres += rng.normal(size=metres.shape) * GPS_NOISE
    degrees = conversion(CRS, WGS84, "GPS")(metres[:, :2])
    return [
        {
            "Make": "clsplat",
            "Model": "synth",
            "GPS:LatitudeRef": "N",
            "GPS:Latitude": _sexagesimal(latitude),
            "GPS:LongitudeRef": "E",
            "GPS:Longitude": _sexagesimal(longitude),
            "GPS:AltitudeRef": 0,
            "GPS:Altitude": float(height),
        }
        for (longitude, latitude), height in zip(degrees, metres[:, 2])
    ]


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Degrees, minutes and seconds of an angle of at least 0 degrees."""
    minutes, seconds = divmod(3600 * degrees, 60)
    whole, minutes = divmod(minutes, 60)
    return float(whole), float(minutes), float(seconds)
