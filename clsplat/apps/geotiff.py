"""Rasters of any size on disk, and cloud-optimised GeoTIFF (COG), through rasterio.

A `Raster` is drawn tile by tile into a temporary file, so that memory does not grow with it; its
overviews are averages of what is known. Only this module has rasterio, whose GDAL writes the
coordinate reference system (CRS) as other programs read it.
"""

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.features
import rasterio.shutil
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.enums import Resampling
from rasterio.errors import CRSError, RasterioError
from rasterio.windows import Window

from clsplat.apps.map_grid import TILE, Bounds, MapGrid
from clsplat.errors import InputError, reason
from clsplat.io.georeference.crs import has_metres, heights_of, normal_crs, pyproj_crs

CACHE_MIB = 64  # of GDAL, which takes 5 % of the memory otherwise
GDAL_ERRORS = RasterioError, CRSError, CPLE_BaseError
Place = tuple[int, int]  # of a tile: column, row
NORTH_UP = 1e-6  # of a pixel: how much less square or more turned it may be
VERTICAL = "VERTICAL_REFERENCE"  # a tag
MOST_SIDE = 3000  # pixels of a surface in memory
FINER = 4  # places along a side of a pixel that are inside a polygon or outside


class Raster:
    """A raster in a temporary file: float32 if its `nodata`, where nothing is known, is nan, else
    uint8; and uint8 red, green, blue and alpha if that is None. `bands` are their names and units;
    without a CRS its coordinates are local."""

    def __init__(
        self, path: Path, grid: MapGrid, crs: str | None, bands: Mapping[str, str | None], nodata: float | None
    ) -> None:
        self._path, self.grid, colour = path, grid, nodata is None
        self._bands, self._nodata = dict(bands), nodata
        self._dtype = np.dtype(np.float32 if nodata is not None and np.isnan(nodata) else np.uint8)
        with _writing(path.parent.parent):
            self._file = rasterio.open(
                path,
                "w",
                driver="GTiff",
                width=grid.columns,
                height=grid.rows,
                count=len(bands),
                dtype=self._dtype.name,
                crs=crs,
                tiled=True,
                transform=rasterio.Affine(grid.resolution, 0, grid.left, 0, -grid.resolution, grid.top),
                blockxsize=TILE,
                blockysize=TILE,
                compress="DEFLATE",
                nodata=nodata,
                predictor=2 if self._dtype == np.uint8 else 3,
                alpha="YES" if colour else "NO",
                photometric="RGB" if colour else "MINISBLACK",
                bigtiff="IF_SAFER",
                sparse_ok=True,
            )
        for number, (name, unit) in enumerate(bands.items(), 1):
            self._file.set_band_description(number, name)
            self._file.set_band_unit(number, unit or "")

    @property
    def bands(self) -> list[dict[str, Any]]:
        """The name, type, value of what is unknown and unit of each band, as STAC writes them."""
        nodata = {} if self._nodata is None else {"nodata": "nan" if math.isnan(self._nodata) else self._nodata}
        return [
            {"name": name, "data_type": self._dtype.name, **nodata, **({"unit": unit} if unit else {})}
            for name, unit in self._bands.items()
        ]

    def write(self, place: Place, values: NDArray[Any]) -> None:
        """Replace a square of pixels [S, S, bands], `place` squares (across, down) from the upper
        left corner; what lies beyond the raster is left out."""
        left, top = len(values) * place[0], len(values) * place[1]
        inner = values[: self.grid.rows - top, : self.grid.columns - left].astype(self._dtype)
        with _writing(self._path.parent.parent):
            self._file.write(np.moveaxis(inner, -1, 0), window=Window(left, top, inner.shape[1], inner.shape[0]))

    def finish(self, tags: Mapping[str, str]) -> None:
        """Add tags and overviews, halves of halves down to one tile, and end the writing."""
        sizes = [2**level for level in range(1, self.level(TILE) + 1)]
        self.close()
        with _writing(self._path.parent.parent), rasterio.open(self._path, "r+") as file:
            file.update_tags(**tags)
            if sizes:
                file.build_overviews(sizes, Resampling.average)

    def level(self, largest: float) -> int:
        """The finest level of at most so many pixels along the longer side, TILE or more."""
        return max(0, math.ceil(math.log2(max(self.grid.columns, self.grid.rows) / largest)))

    def whole(self, level: int) -> NDArray[Any]:
        """A level in one piece, [H, W, bands]: for coarse ones."""
        with self._at(level) as file:
            return np.moveaxis(file.read(), 0, -1)

    def close(self) -> None:
        """End the writing of tiles."""
        with _writing(self._path.parent.parent):
            self._file.close()

    def read(self, place: Place, margin: int = 0) -> NDArray[Any]:
        """A tile of a closed raster with so many pixels around it, [H, W, bands]; beyond the raster
        nothing is known."""
        side = TILE + 2 * margin
        window = Window(place[0] * TILE - margin, place[1] * TILE - margin, side, side)
        with self._at(0) as file:
            return np.moveaxis(file.read(window=window, boundless=True), 0, -1)

    def save(self, path: Path) -> None:
        """Replace a file by a COG of the finished raster."""
        partial = self._path.with_name(path.name)
        with _writing(path):
            rasterio.shutil.copy(
                self._path,
                partial,
                driver="COG",
                compress="DEFLATE",
                predictor="YES",
                blocksize=TILE,
                overviews="AUTO",
                bigtiff="IF_SAFER",
                geotiff_version="1.1",
            )
            os.replace(partial, path)

    def _at(self, level: int) -> Any:
        return rasterio.open(self._path, **({"overview_level": level - 1} if level else {}))


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights of a map, or of a part of it, in memory.

    Attributes
    ----------
    path : of the file.
    grid : where the pixels lie.
    heights : float64[rows, columns], map units; nan: unknown.
    crs : as `normal_crs` returns it; None: the coordinates are local.
    vertical : what heights count from, by the file's tag VERTICAL; "": it has none.
    """

    path: Path
    grid: MapGrid
    heights: NDArray[np.float64]
    crs: str | None
    vertical: str = ""

    @property
    def unit(self) -> str:
        """Of lengths and heights, in messages."""
        return "m" if self.crs else "scene units"

    def slices(self, bounds: Bounds) -> tuple[slice, slice]:
        """The rows and the columns with (left, bottom, right, top), and a pixel more; perhaps
        none."""
        sides = self.grid.pixels([bounds[::3], bounds[2:0:-1]]) + [[-1], [2]]
        (left, top), (right, bottom) = np.clip(sides, 0, (self.grid.columns, self.grid.rows)).astype(int).tolist()
        return slice(top, bottom), slice(left, right)

    def within(self, bounds: Bounds) -> "Surface":
        """The part of `slices`."""
        rows, columns = self.slices(bounds)
        size = self.grid.resolution
        grid = replace(
            self.grid,
            left=self.grid.left + columns.start * size,
            top=self.grid.top - rows.start * size,
            rows=rows.stop - rows.start,
            columns=columns.stop - columns.start,
        )
        return replace(self, grid=grid, heights=self.heights[rows, columns])


def read_surface(path: Path, bounds: Bounds | None = None, most: int = MOST_SIDE) -> Surface:
    """Read the first band of a raster as heights.

    Parameters
    ----------
    path : a GeoTIFF whose pixels are square and north up, and whose CRS, if it has one, has metres.
    bounds : (left, bottom, right, top) of the part to read, which two pixels more are added to;
        None: the whole raster.
    most : pixels along a side; of a larger part, means of 2 x 2, 4 x 4, ... pixels are read.
    """
    try:
        # a signalling NaN is one as well
        with bounded_memory(), np.errstate(invalid="ignore"), rasterio.open(path) as file:
            crs, size = _checked(path, file), file.transform.a
            vertical = file.tags().get(VERTICAL, "")
            whole = MapGrid(
                np.eye(3), np.zeros(3), file.transform.c, file.transform.f, size, file.width, file.height, math.inf
            )
            sides = np.array([[0, 0], [file.width, file.height]], np.float64)
            if bounds is not None:
                sides = whole.pixels([bounds[::3], bounds[2:0:-1]]) + [[-2], [2]]
            (left, top), (right, bottom) = np.clip(sides, 0, (file.width, file.height)).astype(int)
            factor = 2 ** max(0, math.ceil(math.log2(max(right - left, bottom - top, 1) / most)))
            left, top = (factor * (int(place) // factor) for place in (left, top))
            columns, rows = int(right - left) // factor, int(bottom - top) // factor
            if not (columns and rows):
                raise InputError(f"{path}: the place lies beyond it; compare the coordinates with those of the map")
            heights = (
                file.read(
                    1,
                    window=Window(left, top, factor * columns, factor * rows),
                    out_shape=(rows, columns),
                    masked=True,
                    resampling=Resampling.average,
                )
                .astype(np.float64)
                .filled(np.nan)
            )
            grid = replace(
                whole,
                left=whole.left + left * size,
                top=whole.top - top * size,
                resolution=size * factor,
                columns=columns,
                rows=rows,
            )
    except GDAL_ERRORS as error:
        raise InputError(
            f"{path}: cannot be read as a GeoTIFF ({reason(error)}); give a surface.tif of `clsplat map`"
        ) from None
    heights[~np.isfinite(heights)] = np.nan
    if bounds is None and np.isnan(heights).all():
        raise InputError(f"{path}: has no heights; make the map anew, of places that photos show")
    return Surface(path, grid, heights, crs, vertical)


def coverage(grid: MapGrid, parts: Sequence[Sequence[NDArray[np.float64]]]) -> NDArray[np.float64]:
    """The share of each pixel, [rows, columns], within polygons; of each its rings [N, 2], the
    outer one first."""
    if not (grid.columns and grid.rows):
        return np.zeros((grid.rows, grid.columns))
    shapes = [{"type": "Polygon", "coordinates": [ring.tolist() for ring in part]} for part in parts]
    step = grid.resolution / FINER
    inside = rasterio.features.geometry_mask(
        shapes,
        (FINER * grid.rows, FINER * grid.columns),
        rasterio.Affine(step, 0, grid.left, 0, -step, grid.top),
        invert=True,
    )
    shares: NDArray[np.float64] = inside.reshape(grid.rows, FINER, grid.columns, FINER).mean((1, 3))
    return shares


def _checked(path: Path, file: Any) -> str | None:
    """The CRS of an open raster; InputError unless it holds heights on a map."""
    place = file.transform
    if file.count > 2 or file.dtypes[0] == "uint8":
        raise InputError(
            f"{path}: has {file.count} bands of {file.dtypes[0]}, as pictures have, "
            "not heights; give a surface.tif or terrain.tif of `clsplat map`"
        )
    if (
        not np.isfinite(place[:6]).all()
        or place.a <= 0
        or max(abs(place.b), abs(place.d), abs(place.a + place.e)) > NORTH_UP * abs(place.a)
    ):
        raise InputError(
            f"{path}: its pixels are not square with north at the top; convert it with gdalwarp -tr SIZE SIZE"
        )
    if file.crs is None:
        return None
    crs = normal_crs(file.crs.to_wkt(), str(path))
    if not has_metres(pyproj_crs(crs, str(path))) or heights_of(crs).metres != 1:
        raise InputError(
            f"{path}: its coordinates or heights are not metres; convert it with "
            "gdalwarp -t_srs to a projected system such as EPSG:32632"
        )
    return crs


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Makes errors of GDAL into errors of a file."""
    try:
        yield
    except GDAL_ERRORS as error:
        raise InputError(
            f"{path}: cannot be written ({reason(error)}); free some space, and check that the folder may be written"
        ) from None


def bounded_memory() -> Any:
    """A context that keeps GDAL's memory small, and its messages off the terminal."""
    return rasterio.Env(GDAL_CACHEMAX=CACHE_MIB)
