"""Blending splats to an image, and the adjoint (cl/blend.cl)."""

from dataclasses import dataclass

import numpy as np

from clsplat.device import Array, Kernel
from clsplat.rendering.bin import BUCKET
from clsplat.rendering.project import SPLAT_REALS

_SIZE = dict(width="int", height="int", tiles_x="int", first_tile="int")
_LISTS = dict(ranges=("uint", "T", 2), sorted_splats=("uint", "P"))
_SPLATS = dict(splats=("real", "V", SPLAT_REALS))
_IMAGE = dict(image=("real", 3, "H", "W"), transmittance=("real", "H", "W"), last=("int", "H", "W"),
              depth=("real", "D", "E"))
_GRADS = dict(grad_image=("real", 3, "H", "W"), grad_depth=("real", "D", "E"),
              grad_transmittance=("real", "D", "E"))
_BACKGROUND = dict(background=("real", 3))
_CHECKPOINTS = dict(checkpoints=("real", "B", "X", 4), depth_checkpoints=("real", "C", "Y"))

BLEND = {
    "item": Kernel("blend.cl", "blend", **_SIZE, **_BACKGROUND, **_LISTS, **_SPLATS, **_IMAGE),
    "group": Kernel("blend.cl", "blend", **_SIZE, **_BACKGROUND, **_LISTS,
                    bucket_offsets=("uint", "T"), **_SPLATS, **_IMAGE, **_CHECKPOINTS)}
ADJOINT = {
    "item": Kernel("blend.cl", "blend_adjoint", **_SIZE, **_BACKGROUND, **_LISTS,
                   slots=("uint", "P"), **_SPLATS, transmittance=("real", "H", "W"),
                   last=("int", "H", "W"), **_GRADS, sums=("real", "P", "S")),
    "group": Kernel("blend.cl", "blend_adjoint", **_SIZE, tiles="uint", **_LISTS,
                    slots=("uint", "P"), bucket_offsets=("uint", "T"), bucket_tiles=("uint", "B"),
                    **_SPLATS, image=("real", 3, "H", "W"), transmittance=("real", "H", "W"),
                    depth=("real", "D", "E"), last=("int", "H", "W"), **_GRADS, **_CHECKPOINTS,
                    sums=("real", "P", "S"))}
SUM_PAIRS = Kernel("blend.cl", "sum_pairs", count="uint", carried="uint", order=("uint", "V"),
                   counts=("uint", "V"), offsets=("uint", "V"), sums=("real", "P", "S"),
                   totals=("real", "V", "S"))


@dataclass(eq=False)
class Blended:
    """image real[3, H, W], transmittance real[H, W], last int[H, W] (no pair of its band of a later
    index was blended; -1 for none at all), depth real[H, W] or a token of 1 x 1 where it was not
    asked for; and the group form's checkpoints, of the band blended last."""

    image: Array
    transmittance: Array
    last: Array
    depth: Array
    checkpoints: Array | None = None
    depth_checkpoints: Array | None = None


def blend_defines(device, with_depth, smooth_cutoff):
    return (("TILE", device.tile), ("BUCKET", BUCKET), ("WITH_DEPTH", int(with_depth)),
            ("SMOOTH_CUTOFF", int(smooth_cutoff)))


def blend(device, splats, pairs, width, height, background, defines, result=None):
    """Blend splats real[V, 12] by their `pairs` over a background real[3]; returns `Blended`.

    result: a Blended that has the tiles of other bands; without it a new one is made.
    """
    with_depth = dict(defines)["WITH_DEPTH"]
    if result is None:
        depth_shape = (height, width) if with_depth else (1, 1)
        result = Blended(device.empty((3, height, width)), device.empty((height, width)),
                         device.empty((height, width), np.int32), device.empty(depth_shape))
    values = dict(width=width, height=height, tiles_x=pairs.tiles_x, first_tile=pairs.tiles.start,
                  background=background, ranges=pairs.ranges, sorted_splats=pairs.sorted_splats,
                  splats=splats, image=result.image, transmittance=result.transmittance,
                  last=result.last, depth=result.depth)
    tiles, pixels = len(pairs.ranges), device.tile**2
    if device.form == "item":
        device.launch(BLEND["item"], tiles, 1, defines, **values)
        return result
    result.checkpoints = result.depth_checkpoints = None  # never those of two bands at a time
    buckets = len(pairs.bucket_tiles)
    result.checkpoints = device.empty((buckets, pixels, 4))
    result.depth_checkpoints = device.empty((buckets, pixels) if with_depth else (1, 1))
    device.launch(BLEND["group"], tiles * pixels, pixels, defines, **values,
                  bucket_offsets=pairs.bucket_offsets, checkpoints=result.checkpoints,
                  depth_checkpoints=result.depth_checkpoints)
    return result


def blend_adjoint(device, splats, pairs, blended, background, grad_image, grad_depth,
                  grad_transmittance, defines, totals=None):
    """Each splat's sums real[V, 9 or 10] (cl/include/splat.h) from grad_image real[3, H, W], and
    grad_depth and grad_transmittance real[H, W] (1 x 1 tokens where the depth channel is off).

    totals: the sums over earlier bands, to be added to in place; without them they begin at zero.
    """
    _, height, width = blended.image.shape
    columns = 9 + dict(defines)["WITH_DEPTH"]
    sums = device.empty((pairs.count, columns))
    values = dict(width=width, height=height, tiles_x=pairs.tiles_x, first_tile=pairs.tiles.start,
                  ranges=pairs.ranges, sorted_splats=pairs.sorted_splats, slots=pairs.slots,
                  splats=splats, transmittance=blended.transmittance, last=blended.last,
                  grad_image=grad_image, grad_depth=grad_depth,
                  grad_transmittance=grad_transmittance, sums=sums)
    tiles = len(pairs.ranges)
    if device.form == "item":
        device.launch(ADJOINT["item"], tiles, 1, defines, **values, background=background)
    else:
        device.launch(ADJOINT["group"], len(pairs.bucket_tiles) * BUCKET, BUCKET, defines, **values,
                      tiles=tiles, bucket_offsets=pairs.bucket_offsets,
                      bucket_tiles=pairs.bucket_tiles, image=blended.image, depth=blended.depth,
                      checkpoints=blended.checkpoints,
                      depth_checkpoints=blended.depth_checkpoints)
    carried = totals is not None
    if not carried:
        totals = device.empty((len(splats), columns))
    elements = len(splats) if device.form == "item" else len(splats) * columns
    device.launch_each(SUM_PAIRS, elements, defines, count=len(splats),
                       carried=carried, order=pairs.order, counts=pairs.counts,
                       offsets=pairs.offsets, sums=sums, totals=totals)
    return totals
