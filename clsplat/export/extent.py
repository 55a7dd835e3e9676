"""What a map can show: a coarse drawing of a scene and its surroundings, made before the map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_dilation,
    binary_fill_holes,
    binary_opening,
    label,
    map_coordinates,
)

from clsplat.device import Device
from clsplat.evaluation.run import Run
from clsplat.export.map_grid import EXTENT, LARGEST_SIDE, TILE, Bounds, MapGrid
from clsplat.export.orthophoto import MapPainter
from clsplat.scene import Scene

AROUND = 0.5  # of the extent of the sparse points, on each side
LEAST_PART = 0.05  # of the largest part that is known: smaller islands are stray gaussians
BESIDE = 2  # pixels around what is known that are drawn, too


@dataclass(frozen=True, eq=False)
class Extent:
    """Where a map shows anything.

    Attributes
    ----------
    grid : of one tile, around the scene.
    known : bool[TILE, TILE], which of its pixels have a height, lie beside one that does, or are
        enclosed by these; small islands excepted.
    """

    grid: MapGrid
    known: NDArray[np.bool_]

    def meets(self, bounds: Bounds) -> bool:
        """Whether anything is known within bounds, map coordinates."""
        left, bottom, right, top = bounds
        columns, rows = self.grid.pixels([(left, top), (right, bottom)]).T
        (first, last), (upper, lower) = (np.clip(
            (np.floor(side[0]), np.ceil(side[1])), 0, TILE).astype(int) for side in (columns, rows))
        return bool(self.known[upper:lower, first:last].any())

    def inside(self, grid: MapGrid, column: int, row: int) -> NDArray[np.bool_]:
        """bool[TILE, TILE]: which pixels of a tile of a grid lie where anything is known."""
        left, _, _, top = grid.tile_bounds(column, row)
        steps = (np.arange(TILE) + 0.5) * grid.resolution
        places = np.stack([left + steps, top - steps], axis=1)
        columns, rows = self.grid.pixels(places).T - 0.5
        inside: NDArray[np.bool_] = map_coordinates(
            self.known.astype(np.float32), np.meshgrid(rows, columns, indexing="ij"), order=1) > 0.5
        return inside

    def around(self, grid: MapGrid) -> MapGrid:
        """A grid with the bounds of all that is known."""
        rows, columns = np.nonzero(self.known)
        if not len(rows):
            return grid
        size = self.grid.resolution
        wider = grid.within((self.grid.left + columns.min() * size,
                             self.grid.top - (rows.max() + 1) * size,
                             self.grid.left + (columns.max() + 1) * size,
                             self.grid.top - rows.min() * size))
        return grid if max(wider.columns, wider.rows) > LARGEST_SIDE else wider


def extent_of(device: Device, run: Run, scene: Scene, grid: MapGrid) -> Extent:
    """What the map of a run can show; the arguments are those of `map.write_map`."""
    places = grid.to_map(scene.offset + scene.unit * scene.points)
    (left, bottom), (right, top) = np.quantile(places[:, :2], EXTENT, axis=0)
    size = (1 + 2 * AROUND) * max(right - left, top - bottom, TILE * np.spacing(abs(right))) / TILE
    middle = (left + right) / 2, (bottom + top) / 2
    coarse = replace(grid, left=float(middle[0] - TILE / 2 * size), resolution=float(size),
                     top=float(middle[1] + TILE / 2 * size), columns=TILE, rows=TILE)
    tile = MapPainter(device, run, coarse, scene).tile(0, 0)
    known = binary_opening(np.isfinite(tile.surface[..., 0]), np.ones((3, 3)))
    parts, count = label(known)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    large = (sizes >= LEAST_PART * sizes.max())[parts] & known
    return Extent(coarse, binary_fill_holes(binary_dilation(large, iterations=BESIDE)))
