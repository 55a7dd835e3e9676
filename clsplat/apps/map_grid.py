"""The grid of a map: where its pixels lie in a scene, and the cameras that draw them, also between
the coordinate reference systems (CRS) of the scene and of the map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.evaluation.survey import ground_samples
from clsplat.io.georeference.crs import SHOWN, heights_of, map_crs, on_ground
from clsplat.io.reason import clean
from clsplat.partition.input import ground_axes
from clsplat.partition.region import map_axes as horizontal_axes
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
    ceiling : height in map coordinates, above which nothing is drawn.
    floor : height in map coordinates, below which no height is taken for known.
    reprojection : from the coordinate reference system (CRS) of the scene to that of the map; None:
        they are the same.
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
    reprojection: Reprojection | None = None

    @property
    def tiles(self) -> tuple[int, int]:
        """How many tiles there are (across, down); the last ones reach beyond the map."""
        return -(-self.columns // TILE), -(-self.rows // TILE)

    @property
    def bounds(self) -> Bounds:
        """(left, bottom, right, top), map coordinates."""
        return (self.left, self.top - self.rows * self.resolution,
                self.left + self.columns * self.resolution, self.top)

    def tile_bounds(self, column: int, row: int) -> Bounds:
        """(left, bottom, right, top) of a tile, map coordinates."""
        side = TILE * self.resolution
        left, top = self.left + column * side, self.top - row * side
        return left, top - side, left + side, top

    def within(self, bounds: Bounds) -> MapGrid:
        """The grid with other bounds, which move outwards to multiples of its pixels."""
        size = self.resolution
        left, bottom, right, top = (
            outwards(side / size) * size for outwards, side
            in zip((math.floor, math.floor, math.ceil, math.ceil), bounds))
        return replace(self, left=left, top=top, columns=max(1, round((right - left) / size)),
                       rows=max(1, round((top - bottom) / size)))

    def finer(self, halvings: int) -> MapGrid:
        """The same map, the sides of whose pixels are halved so often."""
        factor = 2**halvings
        return replace(self, resolution=self.resolution / factor, columns=self.columns * factor,
                       rows=self.rows * factor)

    def camera(self, column: int, row: int) -> Camera:
        """The orthographic camera of a tile, in original coordinates, straight above its middle.

        With a reprojection it has the direction and the scale of the map in its middle: those of a
        projection that keeps angles hardly change within a tile.

        Parameters
        ----------
        column, row : of the tile.
        """
        half = TILE / 2 * self.resolution
        x, y = self.left + (2 * column + 1) * half, self.top - (2 * row + 1) * half
        middle, west, east = self.to_scene([(x, y, self.ceiling), (x - half, y, self.ceiling),
                                            (x + half, y, self.ceiling)])
        right, up = east - west, self.axes[2]
        size = float(np.linalg.norm(right)) / TILE  # of a pixel in the scene
        right = right / (size * TILE)
        rotation = np.stack([right, np.cross(right, up), -up])
        return Camera(TILE, TILE, (1 / size, 1 / size), (TILE / 2, TILE / 2), rotation,
                      -rotation @ middle, orthographic=True)

    def to_map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map coordinates float64[N, 3] of points float[N, 3] in original coordinates."""
        places = np.asarray(points, np.float64) @ self.axes.T + self.origin
        return places if self.reprojection is None else self.reprojection.to_map(places)

    def to_scene(self, points: ArrayLike) -> NDArray[np.float64]:
        """Original coordinates float64[N, 3] of points float[N, 3] in map coordinates."""
        places = np.asarray(points, np.float64)
        if self.reprojection is not None:
            places = self.reprojection.to_scene(places)
        result: NDArray[np.float64] = (places - self.origin) @ self.axes
        return result

    def pixels(self, points: ArrayLike) -> NDArray[np.float64]:
        """(column, row) float64[N, 2] of points float[N, 2 or 3] in map coordinates; the centre of
        the first pixel is (0.5, 0.5)."""
        places = np.asarray(points, np.float64)[:, :2]
        return (places - (self.left, self.top)) / (self.resolution, -self.resolution)


def map_grid(scene: Scene, resolution: float | None = None, bounds: Bounds | None = None,
             reprojection: Reprojection | None = None) -> MapGrid:
    """The grid of a scene's map.

    Parameters
    ----------
    scene : a georeferenced scene has axes east, north and up; of another scene, x and y are the
        axes if z points up or nearly so, as up may be estimated, and otherwise the sides of the
        smallest rectangle around its points.
    resolution : map units a pixel; None: as fine as the photos, see `ground_resolution`.
    bounds : (left, bottom, right, top), map coordinates; None: around the sparse points.
    reprojection : as for `MapGrid`.

    Raises
    ------
    clsplat.ClsplatError : the scene has no points, or the map would be too large.
    """
    if not len(scene.points):
        raise InputError(f"{scene.name}: has no points, so the extent of a map is unknown")
    origin = np.zeros(3) if scene.georeference is None else np.array(scene.georeference.offset)
    original = scene.offset + scene.unit * scene.points
    grid = MapGrid(map_axes(scene), origin, 0, 0, 1, 1, 1, 0, reprojection=reprojection)
    places = grid.to_map(original)
    lowest, highest = np.quantile(places[:, 2], HEIGHTS)
    size = float(resolution or ground_resolution(scene))
    (left, bottom), (right, top) = np.quantile(places[:, :2], EXTENT, axis=0)
    below = FOOTROOM * max(highest - lowest, FLAT * math.hypot(right - left, top - bottom))
    if bounds is not None:
        left, bottom, right, top = bounds
    sides = float(right - left), float(top - bottom)
    if size > max(sides):
        raise InputError(f"--resolution {size:g}: a pixel larger than the map, which is "
                         f"{sides[0]:.3g} x {sides[1]:.3g}; give a finer resolution")
    if max(sides) > size * LARGEST_SIDE:
        raise InputError(f"--resolution {size:g}: the map would have {max(sides) / size:.3g} "
                         f"pixels along a side, more than {LARGEST_SIDE:,}; give a coarser "
                         "resolution or smaller --bounds")
    grid = replace(grid, ceiling=float(highest + HEADROOM * (highest - lowest)),
                   floor=float(lowest - below), resolution=size)
    if bounds is None:
        return grid.within((float(left), float(bottom), float(right), float(top)))
    columns, rows = (max(1, round(side / size)) for side in sides)
    return replace(grid, left=float(left), top=float(top), columns=columns, rows=rows)


def map_axes(scene: Scene) -> NDArray[np.float64]:
    """The directions east, north and up of a scene's map as rows [3, 3], right-handed."""
    if scene.up[2] > math.cos(UPRIGHT):
        return np.vstack([horizontal_axes(scene.up), scene.up])
    return ground_axes(scene.up, scene.points, np.ones(len(scene.points)))


def ground_resolution(scene: Scene) -> float:
    """The size of a photo's pixel at the points that it shows, map units, to two digits: the
    median over views."""
    _, sizes = ground_samples(scene, scene.points)
    if not sizes:
        raise InputError(f"{scene.name}: no photo shows a point; give --resolution")
    return float(f"{scene.unit * np.median(sizes):.2g}")


@dataclass(frozen=True)
class Reprojection:
    """From the CRS of a scene to another one and back; heights stay as they are.

    Attributes
    ----------
    scene_crs, map_crs : as `io.georeference.crs.normal_crs` returns them.
    """

    scene_crs: str
    map_crs: str

    def to_map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points float[N, 3] of the scene's CRS in the map's."""
        return on_ground(self.scene_crs, self.map_crs, points)

    def to_scene(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points float[N, 3] of the map's CRS in the scene's."""
        return on_ground(self.map_crs, self.scene_crs, points)


def reprojection_of(own: str, wanted: str) -> Reprojection | None:
    """From a scene's CRS to the one that its map shall have; None if they are the same.

    Raises
    ------
    clsplat.ClsplatError : the wanted one is unknown, not projected with metres as its unit, or has
        another vertical part than the scene's, as heights are not converted.
    """
    crs = map_crs(wanted)
    vertical, known = heights_of(crs).name, heights_of(own).name
    if vertical and vertical != known:
        raise InputError(f"--crs {clean(wanted)[:SHOWN]}: its heights count from {vertical}, those "
                         f"of the scene from {known or 'what its georeference does not name'}, and "
                         "heights are not converted; name the horizontal system alone")
    return None if crs == own else Reprojection(own, crs)
