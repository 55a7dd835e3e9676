"""Photos of a city, and what a survey of it sees, drawn on an OpenCL device (raycast.cl)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from clsplat.device import Array, Device, Kernel, Reading, each
from tools.synth import raycast, texture
from tools.synth.city import BLOCK_WIDTH, KINDS, PAVEMENT, STREET, City
from tools.synth.survey import DETECTION_RATE, IMAGE_BORDER
from tools.synth.texture import Texture

CELL = 1.0  # world units, the width of a cell of the grid
SLACK = 1e-3  # world units by which solids are larger in the grid, for rounding
SURVEY_REALS = 19  # of a packed camera: position, rotation, focal length, centre, gains
PAINT_REALS = 16  # of the colours and measures of a box
MOST_OBSERVATIONS = 30  # of a point
# the standard deviation of lightness at which points begin to be detected, and up to which more are
CONTRAST_LOW, CONTRAST_RANGE = 0.01, 0.12
PATCH_WIDTH, PATCH_GAPS = 4.0, 0.25  # cells of the noise field of gaps, world units; its threshold

SOURCE = str(Path(__file__).with_name("raycast.cl"))
CITY: dict[str, Any] = {
    "box_count": "uint",
    "cells_x": "int",
    "cells_y": "int",
    "blocks_x": "int",
    "blocks_y": "int",
    "grid": ("real", 4),
    "begins": ("uint", "B"),
    "members": ("uint", "M"),
    "tops": ("real", "T"),
    "boxes": ("real", "K", 6),
    "spheres": ("real", "S", 4),
    "kinds": ("uint", "K"),
    "paint": ("real", "K", PAINT_REALS),
    "parks": ("uchar", "X", "Y"),
    "lattice": ("real", *3 * (texture.LATTICE,)),
}
DRAW = Kernel(
    SOURCE,
    "draw",
    each("width height"),
    width="uint",
    height="uint",
    **CITY,
    camera=("real", SURVEY_REALS),
    image=("uchar", "H", "W", 3),
)
OBSERVE = Kernel(
    SOURCE,
    "observe",
    each("count"),
    count="uint",
    view_count="uint",
    first="uint",
    seed="int",
    **CITY,
    points=("real", "N", 3),
    primitives=("uint", "N"),
    cameras=("real", "V", SURVEY_REALS),
    width="real",
    height="real",
    border="real",
    found=("uint", "N"),
    slots=("uint", "N", MOST_OBSERVATIONS),
    colours=("uchar", "N", 3),
)


class Observed(NamedTuple):
    """Which views observe candidates for sparse points."""

    counts: NDArray[np.uint32]  # [N], views of each
    views: NDArray[np.uint32]  # [N, MOST_OBSERVATIONS]; the first `counts` of a row, in no order
    colours: NDArray[np.uint8]  # [N, 3], of those with two or more views


class DeviceCity:
    """A city in the memory of a device; `paints` knows the city and its colours."""

    def __init__(self, device: Device, paints: Texture) -> None:
        self.device, city = device, paints.city
        grid, (cells_x, cells_y), begins, members, tops = grid_of(city)
        paint = np.column_stack(
            [paints.facades, paints.roofs, paints.cars, paints.parts, paints.bays, paints.storeys, paints.window_share]
        )
        self._city: dict[str, Any] = {
            "box_count": len(city.boxes),
            "cells_x": cells_x,
            "cells_y": cells_y,
            "blocks_x": city.blocks[0],
            "blocks_y": city.blocks[1],
            "grid": device.upload(grid),
            "begins": device.upload(begins),
            "members": device.upload(members),
            "tops": device.upload(tops),
            "boxes": device.upload(city.boxes.reshape(-1, 6)),
            "spheres": device.upload(city.spheres),
            "kinds": device.upload(city.kinds, np.uint32),
            "paint": device.upload(paint),
            "parks": device.upload(city.parks, np.uint8),
            "lattice": device.upload(paints.lattice),
        }
        self._defines = _defines(paints)

    def photo(self, camera: Camera, gains: ArrayLike = (1.0, 1.0, 1.0)) -> Reading:
        """A photo uint8[H, W, 3], on its way to the host; `gains` [3] multiply its light."""
        image = self.device.empty((camera.height, camera.width, 3), np.uint8)
        self.device.launch(
            DRAW,
            self._defines,
            width=camera.width,
            height=camera.height,
            **self._city,
            camera=self.device.upload(_packed(camera, gains)),
            image=image,
        )
        return Reading(image)

    def cameras(self, cameras: Sequence[Camera]) -> Array:
        """Cameras in the memory of the device, for `observed`."""
        return self.device.upload(np.array([_packed(camera) for camera in cameras]))

    def observed(
        self,
        points: NDArray[np.float64],
        primitives: NDArray[np.integer],
        cameras: Array,
        size: tuple[int, int],
        first: int,
        seed: int,
    ) -> Observed:
        """Find which views observe points of surfaces.

        Parameters
        ----------
        points : [N, 3], world.
        primitives : [N], as `city.sample_solids` returns them.
        cameras : of all views.
        size : (width, height) of their photos, pixels.
        first : the number of the first point among all candidates; chance depends on it.
        seed : of the chance that points are detected.
        """
        count = len(points)
        found, slots, colours = (
            self.device.empty(shape, dtype)
            for shape, dtype in ((count, np.uint32), ((count, MOST_OBSERVATIONS), np.uint32), ((count, 3), np.uint8))
        )
        self.device.launch(
            OBSERVE,
            self._defines,
            count=count,
            view_count=len(cameras),
            first=first,
            seed=seed & 0x7FFFFFFF,
            **self._city,
            points=self.device.upload(points),
            primitives=self.device.upload(primitives.astype(np.uint32)),
            cameras=cameras,
            width=size[0],
            height=size[1],
            border=min(IMAGE_BORDER, min(size) / 8),
            found=found,
            slots=slots,
            colours=colours,
        )
        return Observed(found.download(), slots.download(), colours.download())


def grid_of(
    city: City,
) -> tuple[NDArray[np.float64], tuple[int, int], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.float64]]:
    """The lists of the solids over each cell of a grid over x and y.

    Returns the low corner (x, y) of the grid, the width of a cell and the highest top [4]; the
    number of cells along x and y; where the list of each cell begins [cells + 1], row by row of y;
    the primitives [M] in the lists; and the highest top [cells] over each cell, -1 over empty ones.
    """
    bounds = city.bounds + SLACK * np.array([[-1], [1]])
    low = bounds[:, 0, :2].min(axis=0)
    first, last = np.moveaxis(np.floor((bounds[:, :, :2] - low) / CELL).astype(int), 1, 0)
    size = last.max(axis=0) + 1
    span = last - first + 1
    repeats = span.prod(axis=1)
    solid = np.repeat(np.arange(len(bounds)), repeats)
    within = np.arange(len(solid)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    row, column = np.divmod(within, span[solid, 0])
    cell = (first[solid, 1] + row) * size[0] + first[solid, 0] + column
    tops = np.full(size.prod(), -1.0)
    np.maximum.at(tops, cell, bounds[solid, 1, 2])
    begins = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=size.prod()))])
    members = solid[np.argsort(cell, kind="stable")] + 1
    return (
        np.array([*low, CELL, tops.max()]),
        (int(size[0]), int(size[1])),
        begins.astype(np.uint32),
        members.astype(np.uint32),
        tops,
    )


def _packed(camera: Camera, gains: ArrayLike = (1.0, 1.0, 1.0)) -> NDArray[np.float64]:
    return np.concatenate(
        [camera.position, camera.rotation.ravel(), camera.focal, camera.centre, np.asarray(gains, np.float64)]
    )


def _defines(paints: Texture) -> tuple[tuple[str, object], ...]:
    """The constants of a build, those that the reference in numpy has."""
    vectors = {
        "SUN": zip("XYZ", raycast.SUN),
        "SKY": zip("RGB", raycast.SKY),
        "SUNLIGHT": zip("RGB", raycast.SUNLIGHT),
        "SKYLIGHT": zip("RGB", raycast.SKYLIGHT),
    }
    return (
        ("BLOCK_WIDTH", BLOCK_WIDTH),
        ("STREET", STREET),
        ("PAVEMENT", PAVEMENT),
        ("SAMPLES_PER_SIDE", raycast.SAMPLES_PER_SIDE),
        ("DISPLAY_GAMMA", raycast.DISPLAY_GAMMA),
        ("LATTICE", texture.LATTICE),
        ("EDGE", float(paints.edge)),
        ("OCTAVES", paints.octaves),
        ("COARSEST_GRAIN", texture.COARSEST_GRAIN),
        ("PIXEL", float(paints.detail)),
        ("SURVEY_REALS", SURVEY_REALS),
        ("PAINT_REALS", PAINT_REALS),
        ("MOST_OBSERVATIONS", MOST_OBSERVATIONS),
        ("DETECTION_RATE", DETECTION_RATE),
        ("CONTRAST_LOW", CONTRAST_LOW),
        ("CONTRAST_RANGE", CONTRAST_RANGE),
        ("PATCH_WIDTH", PATCH_WIDTH),
        ("PATCH_GAPS", PATCH_GAPS),
        *((f"KIND_{name.upper()}", number) for number, name in enumerate(KINDS)),
        *((f"{name}_{axis}", float(value)) for name, parts in vectors.items() for axis, value in parts),
    )
