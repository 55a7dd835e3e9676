"""Pairs of tile and splat, sorted by tile and then by depth (cl/bin.cl)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat import constants
from clsplat.device import Array, Device, Forms, Kernel, each, groups, items
from clsplat.errors import DeviceError
from clsplat.primitives.sort import parts_of

PAIR_LIMIT = 2**31 - 1  # blending indexes pairs by int
ANY_NUMBER = 2**32 - 1
HAS_BUCKETS = Forms(item=False, group=True)  # whether the blend adjoint runs over buckets of pairs
NEEDS_ORDER = Forms(item=True, group=False)  # whether pairs are emitted front to back

_BAND = dict(tiles_x="int", first_tile="int", end_tile="int")
_COUNTS = dict(counts=("uint", constants.FRAME_COUNTS))
_SPLATS = dict(splats=("real", "V", constants.SPLAT_REALS))
_RANGES = dict(ranges=("uint", "T", 2))
_PARTS: dict[str, Any] = dict(parts="uint", table=("uint", "C", "T"), totals=("uint", "C"))
_ORDERED: dict[str, Any] = dict(order=("uint", "V"), **_PARTS)
_STEPS = dict(steps=("uint", "S"))
COUNT = Kernel(
    "bin.cl",
    "count_pairs",
    Forms(item=items("parts", **_ORDERED), group=groups("V/SCAN_GROUP", "SCAN_GROUP", **_STEPS, totals=("uint", "C"))),
    **_BAND,
    **_COUNTS,
    **_SPLATS,
    splat_counts=("uint", "V"),
)
PLACE = Kernel(
    "bin.cl",
    "place_pairs",
    Forms(
        item=items("1", **_PARTS),
        group=groups(
            "2",
            "SCAN_GROUP",
            chunks="uint",
            **_STEPS,
            totals=("uint", "C"),
            first_indices=("uint", "C"),
            bucket_offsets=("uint", "T"),
        ),
    ),
    tiles="uint",
    room="uint",
    **_COUNTS,
    **_RANGES,
)
EMIT = Kernel(
    "bin.cl",
    "emit_pairs",
    Forms(
        item=items("parts", **_ORDERED, sorted_splats=("uint", "P"), emission_indices=("uint", "P")),
        group=groups(
            "V/SCAN_GROUP",
            "SCAN_GROUP",
            **_RANGES,
            **_STEPS,
            first_indices=("uint", "C"),
            pair_splats=("uint", "P"),
            keys=("ulong", 2, "P"),
        ),
    ),
    **_BAND,
    **_COUNTS,
    **_SPLATS,
    splat_counts=("uint", "V"),
    offsets=("uint", "V"),
)
SORT = Kernel(
    "bin.cl",
    "sort_tiles",
    groups("T", "SCAN_GROUP"),
    room="uint",
    **_COUNTS,
    **_RANGES,
    **_STEPS,
    pair_splats=("uint", "P"),
    bucket_offsets=("uint", "T"),
    keys=("ulong", 2, "P"),
    sorted_splats=("uint", "P"),
    emission_indices=("uint", "P"),
    bucket_tiles=("uint", "B"),
)
COUNT_TILES = Kernel("bin.cl", "count_tiles", each("V"), tiles_x="int", tiles_y="int", **_COUNTS, **_SPLATS, **_STEPS)


class TooManyPairs(DeviceError):
    """More pairs than one binning may have; the cure is bands of fewer tiles (blend.py)."""


@dataclass(eq=False)
class Pairs:
    """The pairs of a frame, or of a band of it."""

    tiles_x: int  # columns of tiles of the image
    tiles: range  # range of the T tiles, numbered row by row
    counts: Array  # uint[FRAME_COUNTS], of the frame (clsplat/constants.py)
    # splat_counts, offsets: uint[V], how many pairs a splat has, the emission index of its first
    splat_counts: Array
    offsets: Array
    # uint[T, 2], where the pairs of each tile begin and end in the two arrays that follow
    ranges: Array
    sorted_splats: Array  # uint[P], the splat of each pair, sorted by tile and then by depth
    # uint[P], the index that each of these pairs has among those of its splat
    emission_indices: Array
    # uint[T], the first bucket of each tile; in the group form only
    bucket_offsets: Array | None = None
    # uint[B], the tile of each bucket, 0 past the last; B is an upper bound
    bucket_tiles: Array | None = None

    @property
    def count(self) -> int:
        """How many pairs there are, or where only the device knows that, how many there may be."""
        return len(self.sorted_splats)


def tile_grid(device: Device, width: int, height: int) -> tuple[int, int]:
    """(columns, rows) of tiles of an image."""
    return -(-width // device.tile), -(-height // device.tile)


def bin_splats(
    device: Device,
    splats: Array,
    counts: Array,
    order: Array | None,
    width: int,
    height: int,
    band: range | None = None,
    limit: int = PAIR_LIMIT,
    room: int | None = None,
) -> Pairs:
    """Find which splats touch which tiles.

    Parameters
    ----------
    splats : real[V, 12] (cl/include/splat.h), of which the first counts[COUNT_VISIBLE] exist.
    counts : uint[FRAME_COUNTS], of the frame.
    order : uint[V], the splats front to back, where NEEDS_ORDER.
    width, height : size of the image, pixels.
    band : range of tiles, numbered row by row; None: all tiles.
    limit : the largest number of pairs.
    room : the number of pairs for which there is room; a frame with more fails
        (cl/include/counts.h). None: waits for the device, for the number of pairs.

    Raises
    ------
    TooManyPairs : if there are more pairs than the limit.
    """
    tiles_x, tiles_y = tile_grid(device, width, height)
    band = range(tiles_x * tiles_y) if band is None else band
    tiles, number = len(band), len(splats)
    splat_counts, offsets = (device.empty(number, np.uint32) for _ in range(2))
    ranges = device.empty((tiles, 2), np.uint32)
    shared: dict[str, Any] = dict(
        tiles_x=tiles_x,
        first_tile=band.start,
        end_tile=band.stop,
        counts=counts,
        splats=splats,
        splat_counts=splat_counts,
        ranges=ranges,
        **_scratch(device, number, tiles, order),
    )
    before = counts.copied() if room is None else counts
    _launch(device, COUNT, **shared)
    _launch(device, PLACE, **shared, tiles=tiles, room=ANY_NUMBER if room is None else room)
    if room is None:
        room = _number_of_pairs(counts, before, min(limit, PAIR_LIMIT), width, height)
    sorted_splats, emission_indices = (device.empty(room, np.uint32) for _ in range(2))
    pairs = Pairs(tiles_x, band, counts, splat_counts, offsets, ranges, sorted_splats, emission_indices)
    shared |= dict(offsets=offsets, sorted_splats=sorted_splats, emission_indices=emission_indices)
    if HAS_BUCKETS.of(device):
        # every tile wastes less than one bucket
        pairs.bucket_tiles = device.empty(room // device.bucket + tiles, np.uint32)
        pairs.bucket_offsets = shared["bucket_offsets"]
        shared |= dict(
            pair_splats=device.empty(room, np.uint32),
            keys=device.empty((2, room), np.uint64),
            bucket_tiles=pairs.bucket_tiles,
        )
    _launch(device, EMIT, **shared)
    if not NEEDS_ORDER.of(device):
        _launch(device, SORT, **shared, room=room)
    return pairs


def count_tiles(device: Device, splats: Array, counts: Array, width: int, height: int) -> NDArray[np.int64]:
    """How many pairs each tile has, int64[T], tiles numbered row by row; waits for the device."""
    tiles_x, tiles_y = tile_grid(device, width, height)
    steps = device.empty(tiles_x * tiles_y + 1, np.uint32)
    steps.fill(0)
    device.launch(COUNT_TILES, tiles_x=tiles_x, tiles_y=tiles_y, counts=counts, splats=splats, steps=steps)
    return np.cumsum(steps.download(), dtype=np.uint32)[:-1].astype(np.int64)


def _scratch(device: Device, splats: int, tiles: int, order: Array | None) -> dict[str, Any]:
    """What counting leaves for emission."""
    if NEEDS_ORDER.of(device):
        parts = parts_of(device)
        return dict(
            order=order,
            parts=parts,
            table=device.empty((parts, tiles), np.uint32),
            totals=device.empty(parts, np.uint32),
        )
    chunks = -(-splats // device.scan_group)
    return dict(
        steps=device.zeros_once(tiles + 1, np.uint32),
        chunks=chunks,
        totals=device.empty(chunks, np.uint32),
        first_indices=device.empty(chunks, np.uint32),
        bucket_offsets=device.empty(tiles, np.uint32),
    )


def _launch(device: Device, kernel: Kernel, **values: Any) -> None:
    """Launch a kernel with those of the values that its form on the device has."""
    device.launch(kernel, **{name: values.get(name) for name in kernel.names})


def _number_of_pairs(counts: Array, before: Array, limit: int, width: int, height: int) -> int:
    """The number of pairs; waits. TooManyPairs above the limit, and `counts` is as `before`."""
    read = counts.download()
    needed = int(max(read[constants.COUNT_PAIRS], read[constants.COUNT_NEEDED_PAIRS]))
    if needed > limit:
        counts.write(before.download())
        raise TooManyPairs(
            f"{needed} pairs of tile and splat in one {width} x {height} image, "
            f"more than {limit}: use smaller images (-r)"
        )
    return needed
