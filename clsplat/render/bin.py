"""Pairs of tile and splat, in tile and then depth order (cl/bin.cl)."""

from dataclasses import dataclass

import numpy as np

from clsplat.device import Array, Kernel
from clsplat.errors import DeviceError
from clsplat.primitives.scan import exclusive_scan
from clsplat.primitives.sort import stable_sort
from clsplat.render.project import SPLAT_REALS

BUCKET = 32  # pairs a bucket of the group form's adjoint
PAIR_LIMIT = 2**32 - 1  # slots are 32-bit

COUNT = Kernel("bin.cl", "count_pairs", count="uint", tiles_x="int", tiles_y="int",
               order=("uint", "V"), splats=("real", "V", SPLAT_REALS), counts=("uint", "V"))
EMIT = Kernel("bin.cl", "emit_pairs", count="uint", tiles_x="int", tiles_y="int",
              order=("uint", "V"), splats=("real", "V", SPLAT_REALS), counts=("uint", "V"),
              offsets=("uint", "V"), pair_tiles=("uint", "P"), pair_splats=("uint", "P"))
RANGES = Kernel("bin.cl", "find_ranges", count="uint", tiles="uint", sorted_tiles=("uint", "P"),
                slots=("uint", "P"), pair_splats=("uint", "P"), ranges=("uint", "T", 2),
                sorted_splats=("uint", "P"))
COUNT_BUCKETS = Kernel("bin.cl", "count_buckets", tiles="uint", ranges=("uint", "T", 2),
                       counts=("uint", "T"))
FILL_BUCKETS = Kernel("bin.cl", "fill_buckets", tiles="uint", counts=("uint", "T"),
                      offsets=("uint", "T"), bucket_tiles=("uint", "B"))


@dataclass(eq=False)
class Pairs:
    """The pairs of a frame. order: uint[V], the splats front to back; counts, offsets: uint[V], the
    slots of each in that order; ranges: uint[T, 2] into
    sorted_splats and slots: uint[P]; the group form also has bucket_offsets uint[T] and
    bucket_tiles uint[B], where B is an upper bound and spare entries hold T."""

    tiles_x: int
    tiles_y: int
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


def bin_splats(device, splats, order, width, height):
    """Pairs of the splats real[V, 12] with the tiles of a width x height image; order: uint[V],
    the splats front to back.

    Waits for the device once, for the number of pairs. Raises DeviceError past 2^32 pairs.
    """
    count, tile = len(splats), device.tile
    tiles_x, tiles_y = -(-width // tile), -(-height // tile)
    tiles = tiles_x * tiles_y
    defines = (("TILE", tile), ("BUCKET", BUCKET))
    shape = dict(tiles_x=tiles_x, tiles_y=tiles_y, order=order)
    counts = device.empty(count, np.uint32)
    device.launch_each(COUNT, count, defines, count=count, **shape, splats=splats, counts=counts)
    offsets, totals = exclusive_scan(device, counts)
    pair_count = int(totals.last())
    if pair_count > PAIR_LIMIT:
        raise DeviceError(f"{pair_count} pairs of tile and splat in one {width} x {height} image, "
                          f"more than {PAIR_LIMIT}: use smaller images (-r)")
    pair_tiles, pair_splats = (device.empty(pair_count, np.uint32) for _ in range(2))
    device.launch_each(EMIT, count, defines, count=count, **shape, splats=splats, counts=counts,
                  offsets=offsets, pair_tiles=pair_tiles, pair_splats=pair_splats)
    # `tiles` itself is a key too: what emit_pairs writes where there is nothing to emit
    sorted_tiles, slots = stable_sort(device, pair_tiles, bits=tiles.bit_length())
    ranges = device.empty((tiles, 2), np.uint32)
    ranges.fill(0)
    sorted_splats = device.empty(pair_count, np.uint32)
    device.launch_each(RANGES, pair_count, defines, count=pair_count, tiles=tiles,
                  sorted_tiles=sorted_tiles, slots=slots, pair_splats=pair_splats, ranges=ranges,
                  sorted_splats=sorted_splats)
    pairs = Pairs(tiles_x, tiles_y, order, counts, offsets, ranges, sorted_splats, slots)
    if device.form == "group":
        _add_buckets(device, pairs, tiles, defines)
    return pairs


def _add_buckets(device, pairs, tiles, defines):
    counts = device.empty(tiles, np.uint32)
    device.launch_each(COUNT_BUCKETS, tiles, defines, tiles=tiles, ranges=pairs.ranges,
                  counts=counts)
    pairs.bucket_offsets, _ = exclusive_scan(device, counts)
    # every tile wastes less than one bucket: an upper bound needs no wait
    pairs.bucket_tiles = device.empty(pairs.count // BUCKET + tiles, np.uint32)
    pairs.bucket_tiles.fill(tiles)
    device.launch_each(FILL_BUCKETS, tiles, defines, tiles=tiles, counts=counts,
                  offsets=pairs.bucket_offsets, bucket_tiles=pairs.bucket_tiles)
