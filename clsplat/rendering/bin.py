"""Pairs of tile and splat, in tile and then depth order (cl/bin.cl)."""

from dataclasses import dataclass

import numpy as np

from clsplat.constants import BUCKET, SPLAT_REALS
from clsplat.device import Array, Forms, Kernel, each
from clsplat.errors import DeviceError
from clsplat.primitives.scan import exclusive_scan
from clsplat.primitives.sort import stable_sort

PAIR_LIMIT = 2**31 - 1  # blending numbers a tile's pairs by int
HAS_BUCKETS = Forms(item=False, group=True)  # whether the blend adjoint goes by buckets of pairs

_BAND = dict(tiles_x="int", first_tile="int", end_tile="int")
COUNT = Kernel("bin.cl", "count_pairs", each("count"), count="uint", **_BAND, order=("uint", "V"),
               splats=("real", "V", SPLAT_REALS), counts=("uint", "V"))
COUNT_TILES = Kernel("bin.cl", "count_tiles", each("count"), count="uint", tiles_x="int",
                     tiles_y="int", splats=("real", "V", SPLAT_REALS), steps=("uint", "S"))
EMIT = Kernel("bin.cl", "emit_pairs", each("count"), count="uint", **_BAND, order=("uint", "V"),
              splats=("real", "V", SPLAT_REALS), counts=("uint", "V"), offsets=("uint", "V"),
              pair_tiles=("uint", "P"), pair_splats=("uint", "P"))
RANGES = Kernel("bin.cl", "find_ranges", each("count"), count="uint", tiles="uint",
                sorted_tiles=("uint", "P"), slots=("uint", "P"), pair_splats=("uint", "P"),
                ranges=("uint", "T", 2), sorted_splats=("uint", "P"))
COUNT_BUCKETS = Kernel("bin.cl", "count_buckets", each("tiles"), tiles="uint",
                       ranges=("uint", "T", 2), counts=("uint", "T"))
FILL_BUCKETS = Kernel("bin.cl", "fill_buckets", each("tiles"), tiles="uint", counts=("uint", "T"),
                      offsets=("uint", "T"), bucket_tiles=("uint", "B"))


class TooManyPairs(DeviceError):
    """More pairs than one binning may have; bands of fewer tiles are the cure (bands.py)."""


@dataclass(eq=False)
class Pairs:
    """The pairs of a frame, or of a band of it. tiles: range of the T tiles, numbered row by row;
    order: uint[V], the splats front to back; counts, offsets: uint[V], the slots of each in that
    order; ranges: uint[T, 2] into sorted_splats and slots: uint[P]; the group form also has
    bucket_offsets uint[T] and bucket_tiles uint[B], where B is an upper bound and spare entries
    hold T."""

    tiles_x: int
    tiles: range
    order: Array
    counts: Array
    offsets: Array
    ranges: Array
    sorted_splats: Array
    slots: Array
    bucket_offsets: Array | None = None
    bucket_tiles: Array | None = None

    @property
    def count(self):
        return len(self.slots)


def tile_grid(device, width, height):
    """(columns, rows) of tiles of an image."""
    return -(-width // device.tile), -(-height // device.tile)


def bin_splats(device, splats, order, width, height, band=None, limit=PAIR_LIMIT):
    """Pairs of the splats real[V, 12] with the tiles of a width x height image; order: uint[V],
    the splats front to back; band: range of tiles, numbered row by row; None takes all.

    Waits for the device once, for the number of pairs. Raises TooManyPairs past `limit`.
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
    # `tiles` itself is a key too: what emit_pairs writes where there is nothing to emit
    sorted_tiles, slots = stable_sort(device, pair_tiles, bits=tiles.bit_length())
    ranges = device.empty((tiles, 2), np.uint32)
    ranges.fill(0)
    sorted_splats = device.empty(pair_count, np.uint32)
    device.launch(RANGES, count=pair_count, tiles=tiles, sorted_tiles=sorted_tiles, slots=slots,
                  pair_splats=pair_splats, ranges=ranges, sorted_splats=sorted_splats)
    pairs = Pairs(tiles_x, band, order, counts, offsets, ranges, sorted_splats, slots)
    if HAS_BUCKETS.of(device):
        _add_buckets(device, pairs, tiles)
    return pairs


def count_tiles(device, splats, width, height):
    """int64[T] on the host: the pairs of each tile, numbered row by row. Waits for the device."""
    tiles_x, tiles_y = tile_grid(device, width, height)
    steps = device.empty(tiles_x * tiles_y + 1, np.uint32)
    steps.fill(0)
    device.launch(COUNT_TILES, count=len(splats), tiles_x=tiles_x, tiles_y=tiles_y, splats=splats,
                  steps=steps)
    return np.cumsum(steps.download(), dtype=np.uint32)[:-1].astype(np.int64)


def _add_buckets(device, pairs, tiles):
    counts = device.empty(tiles, np.uint32)
    device.launch(COUNT_BUCKETS, tiles=tiles, ranges=pairs.ranges, counts=counts)
    pairs.bucket_offsets, _ = exclusive_scan(device, counts)
    # every tile wastes less than one bucket: an upper bound needs no wait
    pairs.bucket_tiles = device.empty(pairs.count // BUCKET + tiles, np.uint32)
    pairs.bucket_tiles.fill(tiles)
    device.launch(FILL_BUCKETS, tiles=tiles, counts=counts, offsets=pairs.bucket_offsets,
                  bucket_tiles=pairs.bucket_tiles)
