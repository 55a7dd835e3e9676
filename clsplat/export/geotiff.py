"""Rasters of any size on disk, and cloud-optimised GeoTIFF (COG), through rasterio.

A `Raster` is drawn tile by tile into a temporary file, so that memory does not grow with it; its
overviews are averages of what is known. Only this module has rasterio, whose GDAL writes the
coordinate reference system (CRS) as other programs read it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.export.map_grid import TILE, MapGrid
from clsplat.io.atomic import write_error

CACHE_MIB = 64  # of GDAL, which takes 5 % of the memory otherwise
SHOWN = 60  # characters of a CRS in a message
UNIT_OF_LOCAL = "scene unit"
Place = tuple[int, int]  # of a tile: column, row


class Raster:
    """A raster of uint8 colours with alpha, or of float32 with nan where nothing is known.

    Parameters
    ----------
    path : of the temporary file, created.
    grid : says where the pixels lie.
    crs : name or definition of the CRS; None: a local one.
    bands : name and unit of each band.
    colour : whether the bands are red, green, blue and alpha.
    """

    def __init__(self, path: Path, grid: MapGrid, crs: str | None,
                 bands: Mapping[str, str | None], colour: bool) -> None:
        self._rasterio = rasterio_for("a map")
        self._path, self.grid, self._levels = path, grid, 1
        self._dtype = np.dtype(np.uint8 if colour else np.float32)
        self._file = self._rasterio.open(
            path, "w", driver="GTiff", width=grid.columns, height=grid.rows, count=len(bands),
            dtype=self._dtype.name, crs=crs, transform=_transform(grid), tiled=True,
            blockxsize=TILE, blockysize=TILE, compress="DEFLATE", predictor=2 if colour else 3,
            nodata=None if colour else np.nan, photometric="RGB" if colour else "MINISBLACK",
            alpha="YES" if colour else "NO", bigtiff="IF_SAFER", sparse_ok=True)
        for number, (name, unit) in enumerate(bands.items(), 1):
            self._file.set_band_description(number, name)
            self._file.set_band_unit(number, unit or "")

    @property
    def tiles(self) -> Place:
        """How many tiles there are (across, down)."""
        return self.grid.tiles

    def write(self, place: Place, values: NDArray[Any]) -> None:
        """Replace a tile, [TILE, TILE, bands]; what lies beyond the raster is left out."""
        window = self._window(place, 0, 1)
        height, width = window[0][1] - window[0][0], window[1][1] - window[1][0]
        self._file.write(np.moveaxis(values[:height, :width], -1, 0).astype(self._dtype),
                         window=window)

    def finish(self, tags: Mapping[str, str]) -> None:
        """Add tags and overviews, halves of halves down to one tile, when all tiles are written."""
        sizes = [2**power for power in range(1, 32)
                 if max(self.grid.columns, self.grid.rows) > TILE * 2 ** (power - 1)]
        self._file.update_tags(**tags)
        self._file.close()
        self._levels += len(sizes)
        if sizes:
            with self._rasterio.open(self._path, "r+") as file:
                file.build_overviews(sizes, self._rasterio.enums.Resampling.average)

    def level(self, largest: float, pixels: bool = False) -> int:
        """The finest level of at most so many pixels, in all or along the longer side."""
        sizes = [(-(-self.grid.columns // 2**level), -(-self.grid.rows // 2**level))
                 for level in range(self._levels)]
        return next((level for level, size in enumerate(sizes)
                     if (size[0] * size[1] if pixels else max(size)) <= largest), self._levels - 1)

    def whole(self, level: int) -> NDArray[Any]:
        """A level in one piece, [H, W, bands]: for coarse ones."""
        with self._at(level) as file:
            return np.moveaxis(file.read(), 0, -1)

    def parts(self, level: int) -> Iterator[tuple[int, int, NDArray[Any]]]:
        """(first column, first row, [h, w, bands]) of every tile of a level."""
        with self._at(level) as file:
            for _, window in file.block_windows(1):
                yield window.col_off, window.row_off, np.moveaxis(file.read(window=window), 0, -1)

    @contextmanager
    def reading(self) -> Iterator[Any]:
        """Gives a function of a tile's place and a margin, which reads it, [h, w, bands], with so
        many pixels around it, nan or 0 beyond the raster."""
        self._file.close()
        with self._at(0) as file:
            def read(place: Place, margin: int) -> NDArray[Any]:
                (top, _), (left, _) = self._window(place, margin, 1)
                window = self._rasterio.windows.Window(left, top, TILE + 2 * margin,
                                                       TILE + 2 * margin)
                return np.moveaxis(file.read(window=window, boundless=True,
                                             fill_value=file.nodata or 0), 0, -1)
            yield read

    def save(self, path: Path) -> None:
        """Replace a file by a COG of the raster."""
        partial = self._path.with_name(path.name)
        options: dict[str, Any] = {"driver": "COG", "compress": "DEFLATE", "predictor": "YES",
                                   "blocksize": TILE, "overviews": "AUTO", "bigtiff": "IF_SAFER",
                                   "geotiff_version": "1.1"}
        with write_error(path):
            self._rasterio.shutil.copy(self._path, partial, **options)
            os.replace(partial, path)
