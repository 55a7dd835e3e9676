"""Rasters of any size on disk, and cloud-optimised GeoTIFF (COG), through rasterio.

A `Raster` is drawn tile by tile into a temporary file, so that memory does not grow with it; its
overviews are averages of what is known. Only this module has rasterio, whose GDAL writes the
coordinate reference system (CRS) as other programs read it.
"""

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.enums import Resampling
from rasterio.errors import CRSError, RasterioError
from rasterio.windows import Window

from clsplat.apps.map_grid import TILE, MapGrid
from clsplat.errors import InputError, reason

CACHE_MIB = 64  # of GDAL, which takes 5 % of the memory otherwise
GDAL_ERRORS = RasterioError, CRSError, CPLE_BaseError
Place = tuple[int, int]  # of a tile: column, row


class Raster:
    """A raster in a temporary file: uint8 red, green, blue and alpha if it has `colour`, else
    float32 with nan where nothing is known. `bands` are their names and units; without a CRS its
    coordinates are local."""

    def __init__(self, path: Path, grid: MapGrid, crs: str | None,
                 bands: Mapping[str, str | None], colour: bool) -> None:
        self._path, self.grid = path, grid
        self._dtype = np.dtype(np.uint8 if colour else np.float32)
        with _writing(path.parent.parent):
            self._file = rasterio.open(
                path, "w", driver="GTiff", width=grid.columns, height=grid.rows, count=len(bands),
                dtype=self._dtype.name, crs=crs, tiled=True, transform=rasterio.Affine(
                    grid.resolution, 0, grid.left, 0, -grid.resolution, grid.top),
                blockxsize=TILE, blockysize=TILE, compress="DEFLATE", predictor=2 if colour else 3,
                nodata=None if colour else np.nan, photometric="RGB" if colour else "MINISBLACK",
                alpha="YES" if colour else "NO", bigtiff="IF_SAFER", sparse_ok=True)
        for number, (name, unit) in enumerate(bands.items(), 1):
            self._file.set_band_description(number, name)
            self._file.set_band_unit(number, unit or "")

    def write(self, place: Place, values: NDArray[Any]) -> None:
        """Replace a square of pixels [S, S, bands], `place` squares (across, down) from the upper
        left corner; what lies beyond the raster is left out."""
        left, top = len(values) * place[0], len(values) * place[1]
        inner = values[:self.grid.rows - top, :self.grid.columns - left].astype(self._dtype)
        with _writing(self._path.parent.parent):
            self._file.write(np.moveaxis(inner, -1, 0),
                             window=Window(left, top, inner.shape[1], inner.shape[0]))

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
                self._path, partial, driver="COG", compress="DEFLATE", predictor="YES",
                blocksize=TILE, overviews="AUTO", bigtiff="IF_SAFER", geotiff_version="1.1")
            os.replace(partial, path)

    def _at(self, level: int) -> Any:
        return rasterio.open(self._path, **({"overview_level": level - 1} if level else {}))


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Makes errors of GDAL into errors of a file."""
    try:
        yield
    except GDAL_ERRORS as error:
        raise InputError(f"{path}: cannot be written ({reason(error)}); free some space, and check "
                         "that the folder may be written") from None


def bounded_memory() -> Any:
    """A context that keeps GDAL's memory small, and its messages off the terminal."""
    return rasterio.Env(GDAL_CACHEMAX=CACHE_MIB)
