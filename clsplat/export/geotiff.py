"""Rasters of any size on disk: tiles that are compressed as they come, overviews, and GeoTIFF.

A `TileStore` holds the tiles of one raster as a TIFF file will hold them, so that memory does not
grow with the raster and writing the file is copying. Overviews are rasters of half the size each.
The tags that place a raster on the earth are those of OGC GeoTIFF 1.1 (OGC 19-008r4).
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from clsplat.export.map_grid import TILE, MapGrid
from clsplat.io.atomic import replacing

BIGTIFF_FROM = (1 << 32) - (1 << 25)  # bytes of tiles; the tags need some room below 4 GiB
COMPRESSION_LEVEL = 6
NO_DATA = "nan"
# tags, and keys of the geo key directory
PIXEL_SCALE, TIEPOINT, GEO_KEYS, GEO_ASCII, GDAL_NODATA = 33550, 33922, 34735, 34737, 42113
MODEL_TYPE, RASTER_TYPE, CITATION, PROJECTED_CRS, PROJECTED_CITATION, LINEAR_UNITS = (
    1024, 1025, 1026, 3072, 3073, 3076)
PROJECTED, USER_DEFINED, PIXEL_IS_AREA, METRE = 1, 32767, 1, 9001


class TileStore:
    """The tiles of a raster, row by row, in a temporary file that disappears when it is closed.

    Parameters
    ----------
    folder : where the temporary file lies; it becomes as large as the GeoTIFF.
    columns, rows : size of the raster, pixels.
    samples : values of a pixel; 1: tiles are [TILE, TILE].
    dtype : uint8, or float32 with nan where nothing is known.
    """

    def __init__(self, folder: Path, columns: int, rows: int, samples: int, dtype: type) -> None:
        self.columns, self.rows, self.samples, self.dtype = columns, rows, samples, np.dtype(dtype)
        self._folder, self._places = folder, list[tuple[int, int]]()
        self._file = tempfile.TemporaryFile(dir=folder)

    def __enter__(self) -> TileStore:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._file.close()

    @property
    def tiles(self) -> tuple[int, int]:
        """How many tiles there are (across, down)."""
        return -(-self.columns // TILE), -(-self.rows // TILE)

    @property
    def nbytes(self) -> int:
        """The size of all tiles so far, compressed."""
        return sum(size for _, size in self._places)

    def append(self, tile: NDArray[Any]) -> None:
        """Add the next tile, [TILE, TILE] or [TILE, TILE, samples]."""
        values = np.array(tile, self.dtype, order="C")
        if self.dtype == np.uint8:  # TIFF's horizontal predictor
            values[:, 1:] = np.diff(values, axis=1)  # modulo 256
        encoded = zlib.compress(values.data, COMPRESSION_LEVEL)
        self._places.append((self._file.seek(0, 2), len(encoded)))
        self._file.write(encoded)

    def read(self, column: int, row: int) -> NDArray[Any]:
        """A tile as it was given to `append`; one beyond the raster is empty."""
        shape = (TILE, TILE) if self.samples == 1 else (TILE, TILE, self.samples)
        across, down = self.tiles
        if not (column < across and row < down):
            return np.full(shape, np.nan if self.dtype == np.float32 else 0, self.dtype)
        values = np.frombuffer(zlib.decompress(self._encoded(column + row * across)), self.dtype)
        tile = values.reshape(shape)
        return np.cumsum(tile, axis=1, dtype=np.uint8) if self.dtype == np.uint8 else tile

    def encoded(self) -> Iterator[bytes]:
        """All tiles, compressed, as a TIFF file holds them."""
        return map(self._encoded, range(len(self._places)))

    def whole(self) -> NDArray[Any]:
        """The raster in one piece: for small ones, such as coarse overviews."""
        across, down = self.tiles
        rows = [np.concatenate([self.read(x, y) for x in range(across)], axis=1)
                for y in range(down)]
        return np.concatenate(rows)[:self.rows, :self.columns]

    def halved(self) -> TileStore:
        """The raster of half the size, each pixel of which is the mean of the known ones of four.
        """
        half = TileStore(self._folder, -(-self.columns // 2), -(-self.rows // 2), self.samples,
                         self.dtype.type)
        for y in range(half.tiles[1]):
            for x in range(half.tiles[0]):
                four = [np.concatenate([self.read(2 * x, row), self.read(2 * x + 1, row)], axis=1)
                        for row in (2 * y, 2 * y + 1)]
                half.append(halved_pixels(np.concatenate(four)))
        return half

    def _encoded(self, index: int) -> bytes:
        place, size = self._places[index]
        self._file.seek(place)
        return self._file.read(size)


def halved_pixels(pixels: NDArray[Any]) -> NDArray[Any]:
    """[H/2, W/2, ...]: means of 2 x 2 pixels, of heights without nan, of colours by alpha."""
    height, width = (side // 2 for side in pixels.shape[:2])
    four = pixels.reshape(height, 2, width, 2, *pixels.shape[2:]).astype(np.float32)
    if pixels.ndim == 2:
        known = ~np.isnan(four)
        number = known.sum(axis=(1, 3))
        total = np.where(known, four, 0).sum(axis=(1, 3))
        return np.where(number > 0, total / np.maximum(number, 1), np.nan).astype(np.float32)
    alpha = four[..., 3:]
    weight = alpha.sum(axis=(1, 3))
    colours = (four[..., :3] * alpha).sum(axis=(1, 3)) / np.maximum(weight, 1)
    result = np.concatenate([colours, weight / 4], axis=-1)
    return (result + 0.5).astype(np.uint8)


def overviews(store: TileStore, stack: ExitStack, halvings: int = 0) -> list[TileStore]:
    """A raster that was halved so often, and halves of halves of it down to one tile, which `stack`
    will close."""
    levels = [store]
    while len(levels) <= halvings or max(levels[-1].tiles) > 1:
        levels.append(stack.enter_context(levels[-1].halved()))
    return levels[halvings:]


def write_geotiff(path: Path, levels: list[TileStore], grid: MapGrid, crs: str | None,
                  epsg: int | None) -> None:
    """Replace a GeoTIFF file: tiled, deflated, with overviews; BigTIFF where it needs to be.

    Parameters
    ----------
    path : the file.
    levels : the raster and its overviews.
    grid : says where the pixels lie.
    crs : name or definition of the coordinate reference system (CRS); None: a local one.
    epsg : its EPSG code; None: it has none, so that only its text is written.
    """
    colour = levels[0].samples > 1
    place = geo_tags(grid, crs, epsg)
    tags = place + ([] if colour else [(GDAL_NODATA, 2, 0, NO_DATA, True)])
    big = sum(level.nbytes for level in levels) > BIGTIFF_FROM
    with replacing(path) as file, tifffile.TiffWriter(file, bigtiff=big) as writer:
        for number, level in enumerate(levels):
            shape = (level.rows, level.columns) + ((level.samples,) if colour else ())
            writer.write(
                level.encoded(), shape=shape, dtype=level.dtype, tile=(TILE, TILE),
                compression="adobe_deflate", predictor=2 if colour else 1,
                photometric="rgb" if colour else "minisblack", planarconfig="contig",
                extrasamples=["unassalpha"] if colour else None, metadata=None,
                software="clsplat", subfiletype=int(number > 0),
                extratags=tags if number == 0 else tags[len(place):])


def geo_tags(grid: MapGrid, crs: str | None, epsg: int | None
             ) -> list[tuple[int, int, int, Any, bool]]:
    """The tags that say where a raster lies, as tifffile takes them."""
    kind = USER_DEFINED if crs is None else PROJECTED
    name = "scene coordinates" if crs is None else f"EPSG:{epsg}" if epsg else crs
    # TIFF knows ASCII alone, and a bar ends a text
    text = name.encode("ascii", "replace").decode().replace("|", "/") + "|"
    keys = [(MODEL_TYPE, 0, 1, kind), (RASTER_TYPE, 0, 1, PIXEL_IS_AREA),
            (CITATION, GEO_ASCII, len(text), 0)]
    if crs is not None:
        keys += [(PROJECTED_CRS, 0, 1, epsg or USER_DEFINED),
                 (PROJECTED_CITATION, GEO_ASCII, len(text), 0), (LINEAR_UNITS, 0, 1, METRE)]
    directory = np.array([(1, 1, 0, len(keys)), *keys], np.uint16).ravel()
    scale = (grid.resolution, grid.resolution, 0.0)
    tie = (0.0, 0.0, 0.0, grid.left, grid.top, 0.0)
    return [(PIXEL_SCALE, 12, 3, scale, True), (TIEPOINT, 12, 6, tie, True),
            (GEO_KEYS, 3, len(directory), tuple(int(key) for key in directory), True),
            (GEO_ASCII, 2, 0, text, True)]
