"""The arrays that a frame and its adjoint allocate, with the stages in which they live.

They are in the order of `pipeline.Renderer.render` and `adjoint`, which free them when Python drops
the last reference. The frame has a `pipeline.Room`; without one, it lists its visible gaussians in
an array of one slot a gaussian. tests/rendering/test_frame_arrays.py compares the list with what a
device allocates, in both forms.
"""

from typing import Any, NamedTuple

import numpy as np

from clsplat.constants import PAIR_SUMS, SPLAT_REALS, TRANSFORM_REALS
from clsplat.device import ArraySpec, Device
from clsplat.device.device import SMALLEST_BYTES
from clsplat.gaussians import LEARNED
from clsplat.primitives.compact import chunks_of
from clsplat.primitives.sort import DIGIT_BITS, parts_of
from clsplat.rendering.bin import HAS_BUCKETS, NEEDS_ORDER, tile_grid

# of a training step, in order; a frame without an adjoint ends with "blend"
STAGES = ("cull", "compact", "project", "depth sort", "count", "emit", "blend", "loss", "reproject",
          "exposure", "blend adjoint", "project adjoint", "pose", "adam")


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
    splats : gaussians that the view sees, or those for which there is room.
    pairs : of tile and splat, in the largest band (bands.py), or those for which there is room.
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
    token, chunks = (1, 1), chunks_of(device, count)
    arrays = [
        *_uints("flags", count, "cull", "compact"), *_uints("totals", chunks, "cull", "compact"),
        *_uints("visible", splats, "compact", "adam"),
        FrameArray("splats", (splats, SPLAT_REALS), None, "project", "project adjoint"),
        *_uints("depth_keys", splats, "project", "blend"),
        *_uints("splat_counts offsets", splats, "count", "project adjoint"),
        *_uints("ranges", 2 * tiles, "count", "project adjoint"),
        *_uints("sorted_splats emission_indices", pairs, "emit", "project adjoint"),
        FrameArray("image", (3, *pixels), None, "blend", "project adjoint"),
        FrameArray("transmittance", pixels, None, "blend", "project adjoint"),
        FrameArray("last_contributor", pixels, np.int32, "blend", "project adjoint"),
        FrameArray("depth", pixels if with_depth else token, None, "blend", "project adjoint"),
        FrameArray("transforms", (1, TRANSFORM_REALS), None, "blend", "blend"),  # a token
        FrameArray("pair_grads", (pairs, columns), None, "blend adjoint", "project adjoint"),
        *(FrameArray(f"grad_{field.name}", (splats, *field.row_shape(sh_degree)), None,
                     "project adjoint", "adam") for field in LEARNED
          if field.name not in ("sh_constant", "sh_rest")),
        FrameArray("grad_colours", (splats, 3), None, "project adjoint", "adam"),
        FrameArray("directions", (splats, 3), None, "project adjoint", "adam"),
        FrameArray("grad_means", (splats, 2), None, "project adjoint", "adam"),
        *_uints("active", splats, "project adjoint", "adam")]
    if NEEDS_ORDER.of(device):
        parts = parts_of(device)
        arrays += [
            *_uints("keys values sorted_keys", splats, "depth sort", "depth sort"),
            *_uints("table", parts << DIGIT_BITS, "depth sort", "depth sort"),
            *_uints("order", splats, "depth sort", "project adjoint"),
            *_uints("table", parts * tiles, "count", "emit"),
            *_uints("totals", parts, "count", "emit")]
    else:
        chunks = -(-splats // device.scan_group)
        arrays += [
            *_uints("steps", tiles + 1, "count", "emit"),
            *_uints("totals first_indices", chunks, "count", "emit"),
            *_uints("pair_splats", pairs, "emit", "emit"),
            FrameArray("keys", (2, pairs), np.uint64, "emit", "emit")]
    if HAS_BUCKETS.of(device):
        buckets = pairs // device.bucket + tiles
        arrays += [
            *_uints("bucket_offsets", tiles, "count", "project adjoint"),
            *_uints("bucket_tiles", buckets, "emit", "project adjoint"),
            FrameArray("checkpoints", (buckets, device.tile**2, 4), None, "blend",
                       "project adjoint"),
            FrameArray("depth_checkpoints", (buckets, device.tile**2) if with_depth else token,
                       None, "blend", "project adjoint")]
    return arrays


def _uints(names: str, count: int, first: str, last: str) -> list[FrameArray]:
    return [FrameArray(name, (count,), np.uint32, first, last) for name in names.split()]
