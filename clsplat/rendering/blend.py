"""Blending splats to an image, and the adjoint (cl/blend.cl)."""

from dataclasses import dataclass

import numpy as np

from clsplat.constants import PAIR_SUMS, SPLAT_REALS
from clsplat.device import Array, Forms, Kernel, each, groups, items

_SIZE = dict(width="int", height="int", tiles_x="int", first_tile="int")
_LISTS = dict(ranges=("uint", "T", 2), sorted_splats=("uint", "P"))
_SPLATS = dict(splats=("real", "V", SPLAT_REALS))
_IMAGE, _DEPTH = dict(image=("real", 3, "H", "W")), dict(depth=("real", "D", "E"))
_ENDS = dict(transmittance=("real", "H", "W"), last=("int", "H", "W"))
_BACKGROUND = dict(background=("real", 3))
_CHECKPOINTS = dict(checkpoints=("real", "B", "X", 4), depth_checkpoints=("real", "C", "Y"))

BLEND = Kernel(
    "blend.cl", "blend",
    Forms(item=items("T"),
          group=groups("T", "TILE TILE", bucket_offsets=("uint", "T"), **_CHECKPOINTS)),
    **_SIZE, **_BACKGROUND, **_LISTS, **_SPLATS, **_IMAGE, **_ENDS, **_DEPTH)
ADJOINT = Kernel(
    "blend.cl", "blend_adjoint",
    Forms(item=items("T", **_BACKGROUND),
          group=groups("B", "BUCKET", tiles="uint", bucket_offsets=("uint", "T"),
                       bucket_tiles=("uint", "B"), **_IMAGE, **_DEPTH, **_CHECKPOINTS)),
    **_SIZE, **_LISTS, slots=("uint", "P"), **_SPLATS, **_ENDS, grad_image=("real", 3, "H", "W"),
    grad_depth=("real", "D", "E"), grad_transmittance=("real", "D", "E"), sums=("real", "P", "S"))
SUM_PAIRS = Kernel(
    "blend.cl", "sum_pairs", Forms(item=each("count"), group=each("count S")), count="uint",
    carried="uint", order=("uint", "V"), counts=("uint", "V"), offsets=("uint", "V"),
    sums=("real", "P", "S"), totals=("real", "V", "S"))


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


def blend_defines(with_depth, smooth_cutoff=False):
    """The build-time choices of both kernels."""
    return ("WITH_DEPTH", int(with_depth)), ("SMOOTH_CUTOFF", int(smooth_cutoff))


def blend(device, splats, pairs, width, height, background, defines, result=None):
    """Blend splats real[V, 12] by their `pairs` over a background real[3]; returns `Blended`.

    result: a Blended that has the tiles of other bands; without it a new one is made.
    """
    with_depth = dict(defines)["WITH_DEPTH"]
    if result is None:
        depth_shape = (height, width) if with_depth else (1, 1)
        result = Blended(device.empty((3, height, width)), device.empty((height, width)),
                         device.empty((height, width), np.int32), device.empty(depth_shape))
    result.checkpoints = result.depth_checkpoints = None  # never those of two bands at a time
    if pairs.bucket_tiles is not None:
        states = len(pairs.bucket_tiles), device.tile**2
        result.checkpoints = device.empty((*states, 4))
        result.depth_checkpoints = device.empty(states if with_depth else (1, 1))
    device.launch(BLEND, defines, width=width, height=height, tiles_x=pairs.tiles_x,
                  first_tile=pairs.tiles.start, background=background, ranges=pairs.ranges,
                  sorted_splats=pairs.sorted_splats, splats=splats, image=result.image,
                  transmittance=result.transmittance, last=result.last, depth=result.depth,
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
    columns = PAIR_SUMS + dict(defines)["WITH_DEPTH"]
    sums = device.empty((pairs.count, columns))
    device.launch(ADJOINT, defines, width=width, height=height, tiles_x=pairs.tiles_x,
                  first_tile=pairs.tiles.start, background=background, ranges=pairs.ranges,
                  sorted_splats=pairs.sorted_splats, slots=pairs.slots, splats=splats,
                  image=blended.image, transmittance=blended.transmittance, depth=blended.depth,
                  last=blended.last, grad_image=grad_image, grad_depth=grad_depth,
                  grad_transmittance=grad_transmittance, sums=sums, tiles=len(pairs.ranges),
                  bucket_offsets=pairs.bucket_offsets, bucket_tiles=pairs.bucket_tiles,
                  checkpoints=blended.checkpoints, depth_checkpoints=blended.depth_checkpoints)
    carried = totals is not None
    if not carried:
        totals = device.empty((len(splats), columns))
    device.launch(SUM_PAIRS, defines, count=len(splats), carried=carried, order=pairs.order,
                  counts=pairs.counts, offsets=pairs.offsets, sums=sums, totals=totals)
    return totals
