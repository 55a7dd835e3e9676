"""The grid of a map: where its pixels lie in a scene, and the cameras that draw them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.evaluation.survey import ground_samples
from clsplat.partition.region import ground_axes, map_axes
from clsplat.scene import Scene

TILE = 512  # pixels of a side, both of GeoTIFF's tiles and of a frame
LARGEST_SIDE = 1 << 17  # pixels of a map
EXTENT = (0.005, 0.995)  # quantiles of the sparse points within a map
HEIGHTS = (0.001, 0.999)  # quantiles of their heights; outliers lie far above and below
HEADROOM = 0.1  # of the range of heights: gaussians may lie higher than the points
FOOTROOM = 0.05  # likewise below them, and of FLAT times the diagonal of a flat scene
FLAT = 0.25
UPRIGHT = 0.1  # radians, the angle of an up axis with z below which x and y are the map's axes

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class MapGrid:
    """Pixels of a map, north at the top.

    Attributes
    ----------
    axes : float64[3, 3], rows are the directions east, north and up of the map, in the scene.
    origin : float64[3], map coordinates of the scene's original origin.
    left, top : map coordinates of the borders of the first pixel.
    resolution : map units a pixel.
    columns, rows : size, pixels.
    ceiling, floor : heights in map coordinates, above which nothing is drawn, and below which no
        height is taken for known.
    """

    axes: NDArray[np.float64]
    origin: NDArray[np.float64]
    left: float
    top: float
    resolution: float
    columns: int
    rows: int
    ceiling: float
    floor: float = -math.inf

    @property
    def tiles(self) -> tuple[int, int]:
        """How many tiles there are (across, down); the last ones reach beyond the map."""
        return -(-self.columns // TILE), -(-self.rows // TILE)

    @property
    def bounds(self) -> Bounds:
        """(left, bottom, right, top), map coordinates."""
        return (self.left, self.top - self.rows * self.resolution, self.left + self.columns * self.resolution, self.top)

    def tile_bounds(self, column: int, row: int) -> Bounds:
        """(left, bottom, right, top) of a tile, map coordinates."""
        side = TILE * self.resolution
        left, top = self.left + column * side, self.top - row * side
        return left, top - side, left + side, top

    def within(self, bounds: Bounds) -> MapGrid:
        """The grid with other bounds, which move outwards to multiples of its pixels."""
        size = self.resolution
        left, bottom, right, top = (
            outwards(side / size) * size
            for outwards, side in zip((math.floor, math.floor, math.ceil, math.ceil), bounds)
        )
        return replace(
            self,
            left=left,
            top=top,
            columns=max(1, round((right - left) / size)),
            rows=max(1, round((top - bottom) / size)),
        )

    def finer(self, halvings: int) -> MapGrid:
        """The same map, the sides of whose pixels are halved so often."""
        factor = 2**halvings
        return replace(
            self, resolution=self.resolution / factor, columns=self.columns * factor, rows=self.rows * factor
        )

    def camera(self, column: int, row: int) -> Camera:
        """The orthographic camera of a tile, in original coordinates, straight above its middle."""
        left, bottom, right, top = self.tile_bounds(column, row)
        middle = np.array([(left + right) / 2, (bottom + top) / 2, self.ceiling])
        rotation = self.axes * [[1.0], [-1.0], [-1.0]]
        focal = 1 / self.resolution
        return Camera(
            TILE,
            TILE,
            (focal, focal),
            (TILE / 2, TILE / 2),
            rotation,
            -rotation @ ((middle - self.origin) @ self.axes),
            orthographic=True,
        )

    def to_map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map coordinates float64[N, 3] of points float[N, 3] in original coordinates."""
        return np.asarray(points, np.float64) @ self.axes.T + self.origin

    def pixels(self, points: ArrayLike) -> NDArray[np.float64]:
        """(column, row) float64[N, 2] of points float[N, 2 or 3] in map coordinates; the centre of
        the first pixel is (0.5, 0.5)."""
        places = np.asarray(points, np.float64)[:, :2]
        return (places - (self.left, self.top)) / (self.resolution, -self.resolution)


def map_grid(scene: Scene, resolution: float | None = None, bounds: Bounds | None = None) -> MapGrid:
    """The grid of a scene's map.

    Parameters
    ----------
    scene : a georeferenced scene has axes east, north and up; of another scene, x and y are the
        axes if z points up or nearly so, as up may be estimated, and otherwise the sides of the
        smallest rectangle around its points.
    resolution : map units a pixel; None: as fine as the photos, see `ground_resolution`.
    bounds : (left, bottom, right, top), map coordinates; None: around the sparse points.
    """
    if not len(scene.points):
        raise InputError(f"{scene.name}: has no points, so the extent of a map is unknown")
    origin = np.zeros(3) if scene.georeference is None else np.array(scene.georeference.offset)
    axes = (
        np.vstack([map_axes(scene.up), scene.up])
        if scene.up[2] > math.cos(UPRIGHT)
        else ground_axes(scene.up, scene.points, np.ones(len(scene.points)))
    )
    grid = MapGrid(axes, origin, 0, 0, 1, 1, 1, 0)
    places = grid.to_map(scene.offset + scene.unit * scene.points)
    lowest, highest = np.quantile(places[:, 2], HEIGHTS)
    size = float(resolution or ground_resolution(scene))
    (left, bottom), (right, top) = np.quantile(places[:, :2], EXTENT, axis=0)
    below = FOOTROOM * max(highest - lowest, FLAT * math.hypot(right - left, top - bottom))
    if bounds is not None:
        left, bottom, right, top = bounds
    sides = float(right - left), float(top - bottom)
    if size > max(sides):
        raise InputError(
            f"--resolution {size:g}: a pixel larger than the map, which is "
            f"{sides[0]:.3g} x {sides[1]:.3g}; give a finer resolution"
        )
    if max(sides) > size * LARGEST_SIDE:
        raise InputError(
            f"--resolution {size:g}: the map would have {max(sides) / size:.3g} "
            f"pixels along a side, more than {LARGEST_SIDE:,}; give a coarser "
            "resolution or smaller --bounds"
        )
    grid = replace(
        grid, ceiling=float(highest + HEADROOM * (highest - lowest)), floor=float(lowest - below), resolution=size
    )
    if bounds is None:
        return grid.within((float(left), float(bottom), float(right), float(top)))
    columns, rows = (max(1, round(side / size)) for side in sides)
    return replace(grid, left=float(left), top=float(top), columns=columns, rows=rows)


def ground_resolution(scene: Scene) -> float:
    """The size of a photo's pixel at the points that it shows, map units, to two digits: the
    median over views."""
    _, sizes = ground_samples(scene, scene.points)
    if not sizes:
        raise InputError(f"{scene.name}: no photo shows a point; give --resolution, or of a mesh --voxel")
    return float(f"{scene.unit * np.median(sizes):.2g}")
