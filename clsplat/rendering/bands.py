"""Frames whose pairs of tile and splat do not fit: bands of tiles, one after the other.

A band is a run of tiles, numbered row by row. Tiles are blended by themselves, so the image has the
bytes of a frame in one piece. A splat's slots are in the order of its tiles, and bands go on with
its sums where the one before ended: the gradients have the same bytes too. A frame in bands is
binned, and in the group form blended, once more for its adjoint, since nothing of a band is kept.
"""

import numpy as np

from clsplat.errors import DeviceError
from clsplat.rendering.bin import BUCKET, PAIR_LIMIT, tile_grid

FRAME_SHARE = 0.25  # of the device's memory; parameters, moments and photos may have the rest
LARGEST_SHARE = 2 / 3  # of the largest buffer: the pool rounds sizes up by half at most
INDEX_BYTES = 4


def choose_bands(counts, limit):
    """Ranges of tiles, in order and as few as possible, with at most `limit` pairs each.

    counts: int64[T], pairs of each tile. Raises DeviceError where one tile alone has more.
    """
    if counts.max(initial=0) > limit:
        raise DeviceError(f"{counts.max()} pairs of tile and splat in a single tile, more than "
                          f"{limit}: use fewer gaussians (--max-gaussians)")
    ends = np.cumsum(counts)
    bands, first = [], 0
    while first < len(counts):
        before = ends[first] - counts[first]
        end = int(np.searchsorted(ends, before + limit, side="right"))
        bands.append(range(first, end))
        first = end
    return tuple(bands)


def pair_limit(device, width, height, with_depth):
    """Pairs that a band may have: those for which a device has room, and kernels have numbers."""
    sums, checkpoints = pair_reals(device.form, with_depth, device.tile)
    real, (tiles_x, tiles_y) = device.real.itemsize, tile_grid(device, width, height)
    spare = BUCKET * tiles_x * tiles_y if checkpoints else 0  # a bucket that is not full, a tile
    at_once = FRAME_SHARE * device.handle.global_mem_size / (
        2 * INDEX_BYTES + (sums + checkpoints) * real)
    in_a_buffer = LARGEST_SHARE * device.largest_buffer / (max(sums, checkpoints) * real)
    return min(PAIR_LIMIT, int(min(at_once, in_a_buffer)) - spare)


def pair_reals(form, with_depth, tile):
    """Reals a pair: of the adjoint's sums, and of the group form's checkpoints."""
    checkpoints = (4 + with_depth) * tile**2 // BUCKET if form == "group" else 0
    return 9 + with_depth, checkpoints
