"""The arrays that a frame and its adjoint allocate, with the stages in which they live.

They are in the order of `pipeline.Renderer.render` and `adjoint`, which free them when Python drops
the last reference. tests/rendering/test_frame_arrays.py compares the list with what a device
allocates, in both forms.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from clsplat.constants import BUCKET, PAIR_SUMS, SPLAT_REALS
from clsplat.device import ArraySpec, Device
from clsplat.device.device import SMALLEST_BYTES
from clsplat.gaussians import LEARNED
from clsplat.primitives.scan import chunk_size
from clsplat.primitives.sort import digits
from clsplat.rendering.bin import HAS_BUCKETS, tile_grid

# of a training step, in order; a frame without an adjoint ends with "blend"
STAGES = ("cull", "compact", "depth sort", "project", "count", "emit", "tile sort", "buckets",
          "blend", "loss", "reproject", "exposure", "blend adjoint", "project adjoint", "adam")


class FrameArray(NamedTuple):
    """A short-lived array of a step.

    Attributes
    ----------
    name : of the array in the function that allocates it.
    shape, dtype : as for `Device.empty`.
    first, last : the first and the last of STAGES in which it is alive.
    """

    name: str
    shape: tuple[int, ...]
    dtype: Any
    first: str
    last: str

    def nbytes(self, real: np.dtype[Any]) -> int:
        """Bytes that `Device.empty` allocates where the device's real is `real`."""
        return max(ArraySpec(self.shape, self.dtype).nbytes(real), SMALLEST_BYTES)


class FrameSize(NamedTuple):
    """The numbers that decide the sizes of a frame's arrays.

    Attributes
    ----------
    gaussians : of the model.
    splats : gaussians that the view sees.
    pairs : of tile and splat, in the largest band (bands.py).
    width, height : size of the image, pixels.
    """

    gaussians: int
    splats: int
    pairs: int
    width: int
    height: int


def frame_arrays(device: Device, size: FrameSize, sh_degree: int,
                 with_depth: bool = False) -> list[FrameArray]:
    """The arrays of a frame on a device, and of its adjoint."""
    count, splats, pairs, width, height = size
    tiles = int(np.prod(tile_grid(device, width, height)))
    columns, pixels = PAIR_SUMS + with_depth, (height, width)
    token = (1, 1)
    arrays = [
        *_uints("flags depth_keys", count, "cull", "blend"),
        *_scan(device, count, "compact"),
        *_uints("visible_keys", count, "compact", "blend"),
        *_uints("visible", count, "compact", "adam"),
        *_sort(device, splats, 32, "depth sort"),
        *_uints("sorted_keys", splats, "depth sort", "blend"),
        *_uints("order", splats, "depth sort", "project adjoint"),
        FrameArray("splats", (splats, SPLAT_REALS), None, "project", "project adjoint"),
        *_uints("counts offsets", splats, "count", "project adjoint"),
        *_uints("pair_tiles pair_splats", pairs, "emit", "buckets"),
        *_sort(device, pairs, tiles.bit_length(), "tile sort"),
        *_uints("sorted_tiles", pairs, "tile sort", "buckets"),
        *_uints("emission_indices", pairs, "tile sort", "project adjoint"),
        *_uints("sorted_splats", pairs, "buckets", "project adjoint"),
        *_uints("ranges", 2 * tiles, "buckets", "project adjoint"),
        FrameArray("image", (3, *pixels), None, "blend", "project adjoint"),
        FrameArray("transmittance", pixels, None, "blend", "project adjoint"),
        FrameArray("last_contributor", pixels, np.int32, "blend", "project adjoint"),
        FrameArray("depth", pixels if with_depth else token, None, "blend", "project adjoint"),
        FrameArray("pair_grads", (pairs, columns), None, "blend adjoint", "blend adjoint"),
        FrameArray("splat_grads", (splats, columns), None, "blend adjoint", "project adjoint"),
        *(FrameArray(f"grad_{field.name}", (splats, *field.row_shape(sh_degree)), None,
                     "project adjoint", "adam") for field in LEARNED
          if field.name not in ("sh_constant", "sh_rest")),
        FrameArray("grad_colours", (splats, 3), None, "project adjoint", "adam"),
        FrameArray("directions", (splats, 3), None, "project adjoint", "adam"),
        FrameArray("grad_means", (splats, 2), None, "project adjoint", "adam"),
        *_uints("active", splats, "project adjoint", "adam")]
    if HAS_BUCKETS.of(device):
        buckets = pairs // BUCKET + tiles
        arrays += [
            *_uints("bucket_counts", tiles, "buckets", "buckets"),
            *_uints("bucket_offsets", tiles, "buckets", "project adjoint"),
            *_uints("bucket_tiles", buckets, "buckets", "project adjoint"),
            FrameArray("checkpoints", (buckets, device.tile**2, 4), None, "blend",
                       "project adjoint"),
            FrameArray("depth_checkpoints", (buckets, device.tile**2) if with_depth else token,
                       None, "blend", "project adjoint")]
    return arrays


def by_stage(arrays: Iterable[FrameArray]) -> list[list[FrameArray]]:
    """The arrays that are alive in each of STAGES."""
    alive: list[list[FrameArray]] = [[] for _ in STAGES]
    for array in arrays:
        for stage in range(STAGES.index(array.first), STAGES.index(array.last) + 1):
            alive[stage].append(array)
    return alive


def _uints(names: str, count: int, first: str, last: str) -> list[FrameArray]:
    return [FrameArray(name, (count,), np.uint32, first, last) for name in names.split()]


def _scan(device: Device, count: int, stage: str) -> list[FrameArray]:
    """What `exclusive_scan` allocates for `count` elements, in that stage alone."""
    chunks = -(-count // chunk_size(device, count))
    return [*_uints("offsets", count, stage, stage),
            FrameArray("totals", (chunks + 1,), np.uint64, stage, stage)]


def _sort(device: Device, count: int, bits: int, stage: str) -> list[FrameArray]:
    """What `stable_sort` allocates besides its two results; a second pass still has the arrays of
    the first."""
    passes, digit_bits = digits(device, bits)
    chunks = max(1, -(-count // chunk_size(device, count)))
    table = chunks << digit_bits
    again = 2 if passes > 1 else 1
    return [*_uints("table", table, stage, stage), *again * _scan(device, table, stage),
            *_uints("keys values", count, stage, stage)[:2 * (again - 1)]]
