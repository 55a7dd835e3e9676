"""Frames whose pairs of tile and splat do not fit into memory: bands of tiles, one after the other.

A band is a range of consecutive tiles, numbered row by row. Tiles are blended independently, so the
image has the bytes of a frame in one piece. A splat's pairs are emitted in the order of its tiles,
and each band continues the gradient sums where the band before it ended, so the gradients have the
same bytes too. A frame in bands is binned, and in the group form blended, a second time for its
adjoint, since nothing of a band is kept.
"""

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.errors import DeviceError
from clsplat.rendering.bin import HAS_BUCKETS, PAIR_LIMIT, tile_grid
from clsplat.rendering.blend import pair_columns

FRAME_SHARE = 0.25  # of the device's memory; the rest is for parameters, moments and photos
BUFFER_SHARE = 2 / 3  # of the largest buffer: the pool rounds sizes up, by a quarter at most
INDEX_BYTES = 4


def choose_bands(counts: NDArray[np.int64], limit: int) -> tuple[range, ...]:
    """Divide the tiles of a frame into as few bands as possible.

    Parameters
    ----------
    counts : int64[T], the pairs of each tile.
    limit : the largest number of pairs of a band.

    Returns
    -------
    The range of tiles of each band, in order.

    Raises
    ------
    DeviceError : if a single tile has more pairs than the limit.
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


def pair_limit(device: Device, width: int, height: int, with_depth: bool) -> int:
    """The largest number of pairs of a band for which the device has memory and kernels have
    indices."""
    grads, checkpoints = pair_reals(device, with_depth)
    real, (tiles_x, tiles_y) = device.real.itemsize, tile_grid(device, width, height)
    # each tile may have a partial bucket
    spare = device.bucket * tiles_x * tiles_y if checkpoints else 0
    at_once = FRAME_SHARE * device.handle.global_mem_size / (
        2 * INDEX_BYTES + (grads + checkpoints) * real)
    in_a_buffer = BUFFER_SHARE * device.largest_buffer / (max(grads, checkpoints) * real)
    return min(PAIR_LIMIT, int(min(at_once, in_a_buffer)) - spare)


def pair_reals(device: Device, with_depth: bool) -> tuple[int, int]:
    """Reals for each pair: those of its gradients, and its share of a bucket's checkpoints."""
    states = (4 + with_depth) * device.tile**2 // device.bucket
    return pair_columns(3, with_depth), HAS_BUCKETS.of(device) * states
