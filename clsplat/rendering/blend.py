"""Blending of splats into an image, and its adjoint (cl/blend.cl)."""

from dataclasses import dataclass

import numpy as np

from clsplat.constants import FRAME_COUNTS, PAIR_SUMS, SPLAT_REALS
from clsplat.device import Array, Device, Forms, Kernel, each, groups, items
from clsplat.rendering.bin import Pairs

Defines = tuple[tuple[str, int], ...]  # names and values of the build-time choices of a kernel

_SIZE = dict(width="int", height="int", tiles_x="int", first_tile="int")
_LISTS = dict(ranges=("uint", "T", 2), sorted_splats=("uint", "P"))
_SPLATS = dict(splats=("real", "V", SPLAT_REALS))
_IMAGE, _DEPTH = dict(image=("real", 3, "H", "W")), dict(depth=("real", "D", "E"))
_ENDS = dict(transmittance=("real", "H", "W"), last_contributor=("int", "H", "W"))
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
          group=groups("B", "ADJOINT_GROUP", counts=("uint", FRAME_COUNTS),
                       bucket_offsets=("uint", "T"), bucket_tiles=("uint", "B"), **_IMAGE,
                       **_DEPTH, **_CHECKPOINTS)),
    **_SIZE, **_LISTS, emission_indices=("uint", "P"), **_SPLATS, **_ENDS,
    grad_image=("real", 3, "H", "W"), grad_depth=("real", "D", "E"),
    grad_transmittance=("real", "D", "E"), pair_grads=("real", "P", "S"))
SUM_PAIRS = Kernel(
    "blend.cl", "sum_pairs", Forms(item=each("V"), group=each("V S")), carried="uint",
    counts=("uint", FRAME_COUNTS), splat_counts=("uint", "V"), offsets=("uint", "V"),
    pair_grads=("real", "P", "S"), totals=("real", "V", "S"))


@dataclass(eq=False)
class Blended:
    """The result of blending.

    Attributes
    ----------
    image : real[3, H, W].
    transmittance : real[H, W], the share of the background that is visible.
    last_contributor : int[H, W], index in its band of the last pair that was blended, or a later
        one; -1 if there is none. A frame in slabs has no such array.
    depth : real[H, W], or a token of 1 x 1 without the depth channel.
    checkpoints, depth_checkpoints : of the band that was blended last; in the group form only.
    """

    image: Array
    transmittance: Array
    last_contributor: Array | None
    depth: Array
    checkpoints: Array | None = None
    depth_checkpoints: Array | None = None


def blend_defines(with_depth: bool, smooth_cutoff: bool = False) -> Defines:
    """The build-time choices of both kernels."""
    return ("WITH_DEPTH", int(with_depth)), ("SMOOTH_CUTOFF", int(smooth_cutoff))


def blend(device: Device, splats: Array, pairs: Pairs, width: int, height: int, background: Array,
          defines: Defines, result: Blended | None = None) -> Blended:
    """Blend splats over a background.

    Parameters
    ----------
    device : the device of the arrays.
    splats : real[V, 12] (cl/include/splat.h).
    pairs : those of the frame, or of a band of it.
    width, height : size of the image, pixels.
    background : real[3].
    defines : of `blend_defines`.
    result : that of the bands before, to which the tiles of this one are added; None: a new one.
    """
    with_depth = dict(defines)["WITH_DEPTH"]
    if result is None:
        depth_shape = (height, width) if with_depth else (1, 1)
        result = Blended(device.empty((3, height, width)), device.empty((height, width)),
                         device.empty((height, width), np.int32), device.empty(depth_shape))
    result.checkpoints = result.depth_checkpoints = None  # free those of the band before
    if pairs.bucket_tiles is not None:
        states = len(pairs.bucket_tiles), device.tile**2
        result.checkpoints = device.empty((*states, 4))
        result.depth_checkpoints = device.empty(states if with_depth else (1, 1))
    device.launch(BLEND, defines, width=width, height=height, tiles_x=pairs.tiles_x,
                  first_tile=pairs.tiles.start, background=background, ranges=pairs.ranges,
                  sorted_splats=pairs.sorted_splats, splats=splats, image=result.image,
                  transmittance=result.transmittance, last_contributor=result.last_contributor,
                  depth=result.depth, bucket_offsets=pairs.bucket_offsets,
                  checkpoints=result.checkpoints,
                  depth_checkpoints=result.depth_checkpoints)
    return result


def blend_adjoint(device: Device, splats: Array, pairs: Pairs, blended: Blended, background: Array,
                  grad_image: Array, grad_depth: Array, grad_transmittance: Array,
                  defines: Defines, splat_grads: Array | None = None) -> Array:
    """Gradients by splat from gradients by what `blend` made.

    Parameters
    ----------
    device, splats, pairs, background, defines : as they were for `blend`.
    blended : what `blend` returned.
    grad_image : real[3, H, W].
    grad_depth, grad_transmittance : real[H, W], or tokens of 1 x 1 without the depth channel.
    splat_grads : the sums over earlier bands, to which this band is added in place; None: zero.

    Returns
    -------
    real[V, 9 or 10], sums over the pixels of each splat (cl/include/splat.h).
    """
    _, height, width = blended.image.shape
    columns = PAIR_SUMS + dict(defines)["WITH_DEPTH"]
    pair_grads = device.empty((pairs.count, columns))
    device.launch(ADJOINT, defines, width=width, height=height, tiles_x=pairs.tiles_x,
                  first_tile=pairs.tiles.start, background=background, ranges=pairs.ranges,
                  sorted_splats=pairs.sorted_splats, emission_indices=pairs.emission_indices,
                  splats=splats, image=blended.image, transmittance=blended.transmittance,
                  depth=blended.depth, last_contributor=blended.last_contributor,
                  grad_image=grad_image, grad_depth=grad_depth,
                  grad_transmittance=grad_transmittance, pair_grads=pair_grads,
                  counts=pairs.counts, bucket_offsets=pairs.bucket_offsets,
                  bucket_tiles=pairs.bucket_tiles,
                  checkpoints=blended.checkpoints, depth_checkpoints=blended.depth_checkpoints)
    carried = splat_grads is not None
    if splat_grads is None:
        splat_grads = device.empty((len(splats), columns))
    device.launch(SUM_PAIRS, defines, carried=carried, counts=pairs.counts,
                  splat_counts=pairs.splat_counts, offsets=pairs.offsets, pair_grads=pair_grads,
                  totals=splat_grads)
    return splat_grads
