"""Pairs of tile and splat, sorted by tile and then by depth (cl/bin.cl)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SPLAT_REALS
from clsplat.device import Array, Device, Forms, Kernel, each
from clsplat.errors import DeviceError
from clsplat.primitives.scan import exclusive_scan
from clsplat.primitives.sort import stable_sort

PAIR_LIMIT = 2**31 - 1  # blending indexes pairs by int
HAS_BUCKETS = Forms(item=False, group=True)  # whether the blend adjoint runs over buckets of pairs

_BAND = dict(tiles_x="int", first_tile="int", end_tile="int")
COUNT = Kernel("bin.cl", "count_pairs", each("count"), count="uint", **_BAND, order=("uint", "V"),
               splats=("real", "V", SPLAT_REALS), counts=("uint", "V"))
COUNT_TILES = Kernel("bin.cl", "count_tiles", each("count"), count="uint", tiles_x="int",
                     tiles_y="int", splats=("real", "V", SPLAT_REALS), steps=("uint", "S"))
EMIT = Kernel("bin.cl", "emit_pairs", each("count"), count="uint", **_BAND, order=("uint", "V"),
              splats=("real", "V", SPLAT_REALS), counts=("uint", "V"), offsets=("uint", "V"),
              pair_tiles=("uint", "P"), pair_splats=("uint", "P"))
RANGES = Kernel("bin.cl", "find_ranges", each("count"), count="uint", tiles="uint",
                sorted_tiles=("uint", "P"), emission_indices=("uint", "P"),
                pair_splats=("uint", "P"), ranges=("uint", "T", 2), sorted_splats=("uint", "P"))
COUNT_BUCKETS = Kernel("bin.cl", "count_buckets", each("tiles"), tiles="uint",
                       ranges=("uint", "T", 2), counts=("uint", "T"))
FILL_BUCKETS = Kernel("bin.cl", "fill_buckets", each("tiles"), tiles="uint", counts=("uint", "T"),
                      offsets=("uint", "T"), bucket_tiles=("uint", "B"))


class TooManyPairs(DeviceError):
    """More pairs than one binning may have; the cure is bands of fewer tiles (bands.py)."""


@dataclass(eq=False)
class Pairs:
    """The pairs of a frame, or of a band of it.

    Attributes
    ----------
    tiles_x : columns of tiles of the image.
    tiles : range of the T tiles, numbered row by row.
    order : uint[V], the splats front to back.
    counts, offsets : uint[V], in that order: how many pairs a splat has, and the emission index of
        its first.
    ranges : uint[T, 2], where the pairs of each tile begin and end in the two arrays that follow.
    sorted_splats : uint[P], the splat of each pair, sorted by tile and then by depth.
    emission_indices : uint[P], the index that each of these pairs had when it was emitted.
    bucket_offsets : uint[T], the first bucket of each tile; in the group form only.
    bucket_tiles : uint[B], the tile of each bucket; B is an upper bound, unused entries are T.
    """

    tiles_x: int
    tiles: range
    order: Array
    counts: Array
    offsets: Array
    ranges: Array
    sorted_splats: Array
    emission_indices: Array
    bucket_offsets: Array | None = None
    bucket_tiles: Array | None = None

    @property
    def count(self) -> int:
        """How many pairs there are."""
        return len(self.sorted_splats)


def tile_grid(device: Device, width: int, height: int) -> tuple[int, int]:
    """(columns, rows) of tiles of an image."""
    return -(-width // device.tile), -(-height // device.tile)


def bin_splats(device: Device, splats: Array, order: Array, width: int, height: int,
               band: range | None = None, limit: int = PAIR_LIMIT) -> Pairs:
    """Find which splats touch which tiles; waits for the device once, for the number of pairs.

    Parameters
    ----------
    device : the device of the arrays.
    splats : real[V, 12] (cl/include/splat.h).
    order : uint[V], the splats front to back.
    width, height : size of the image, pixels.
    band : range of tiles, numbered row by row; None: all tiles.
    limit : the largest number of pairs.

    Raises
    ------
    TooManyPairs : if there are more pairs than the limit.
    """
    count = len(splats)
    tiles_x, tiles_y = tile_grid(device, width, height)
    band = range(tiles_x * tiles_y) if band is None else band
    tiles = len(band)
    shape = dict(tiles_x=tiles_x, first_tile=band.start, end_tile=band.stop, order=order)
    counts = device.empty(count, np.uint32)
    device.launch(COUNT, count=count, **shape, splats=splats, counts=counts)
    offsets, totals = exclusive_scan(device, counts)
    pair_count = int(totals.last())
    limit = min(limit, PAIR_LIMIT)
    if pair_count > limit:
        raise TooManyPairs(f"{pair_count} pairs of tile and splat in one {width} x {height} image, "
                           f"more than {limit}: use smaller images (-r)")
    pair_tiles, pair_splats = (device.empty(pair_count, np.uint32) for _ in range(2))
    device.launch(EMIT, count=count, **shape, splats=splats, counts=counts, offsets=offsets,
                  pair_tiles=pair_tiles, pair_splats=pair_splats)
    # `tiles` itself is a key too: what emit_pairs writes where it has no pair to emit
    sorted_tiles, emission_indices = stable_sort(device, pair_tiles, bits=tiles.bit_length())
    ranges = device.empty((tiles, 2), np.uint32)
    ranges.fill(0)
    sorted_splats = device.empty(pair_count, np.uint32)
    device.launch(RANGES, count=pair_count, tiles=tiles, sorted_tiles=sorted_tiles,
                  emission_indices=emission_indices, pair_splats=pair_splats, ranges=ranges,
                  sorted_splats=sorted_splats)
    pairs = Pairs(tiles_x, band, order, counts, offsets, ranges, sorted_splats, emission_indices)
    if HAS_BUCKETS.of(device):
        _add_buckets(device, pairs, tiles)
    return pairs


def count_tiles(device: Device, splats: Array, width: int, height: int) -> NDArray[np.int64]:
    """How many pairs each tile has, int64[T], tiles numbered row by row; waits for the device."""
    tiles_x, tiles_y = tile_grid(device, width, height)
    steps = device.empty(tiles_x * tiles_y + 1, np.uint32)
    steps.fill(0)
    device.launch(COUNT_TILES, count=len(splats), tiles_x=tiles_x, tiles_y=tiles_y, splats=splats,
                  steps=steps)
    return np.cumsum(steps.download(), dtype=np.uint32)[:-1].astype(np.int64)


def _add_buckets(device: Device, pairs: Pairs, tiles: int) -> None:
    counts = device.empty(tiles, np.uint32)
    device.launch(COUNT_BUCKETS, tiles=tiles, ranges=pairs.ranges, counts=counts)
    pairs.bucket_offsets, _ = exclusive_scan(device, counts)
    # every tile wastes less than one bucket: an upper bound needs no wait
    pairs.bucket_tiles = device.empty(pairs.count // device.bucket + tiles, np.uint32)
    pairs.bucket_tiles.fill(tiles)
    device.launch(FILL_BUCKETS, tiles=tiles, counts=counts, offsets=pairs.bucket_offsets,
                  bucket_tiles=pairs.bucket_tiles)
