"""Blending of splats into an image, and its adjoint (cl/blend.cl)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from clsplat.constants import FRAME_COUNTS, PAIR_SUMS, SPLAT_REALS, TRANSFORM_REALS
from clsplat.device import Array, Device, Forms, Kernel, groups, items
from clsplat.device.kernel import Argument
from clsplat.errors import ShapeError
from clsplat.rendering.bin import Pairs

BACK_PLANES, FRONT_AND_BACK_PLANES = 3, 7  # of layers (cl/include/layers.h)
Defines = tuple[tuple[str, int], ...]  # names and values of the build-time choices of a kernel

READS_BACKGROUND = Forms(item=True, group=False)  # the adjoint, where the image does not tell

_SIZE = dict(width="int", height="int", tiles_x="int", first_tile="int")
_LISTS = dict(ranges=("uint", "T", 2), sorted_splats=("uint", "P"))
_SPLATS = dict(splats=("real", "V", SPLAT_REALS))
_IMAGE, _DEPTH = dict(image=("real", 3, "H", "W")), dict(depth=("real", "D", "E"))
_ENDS = dict(transmittance=("real", "H", "W"), last_contributor=("int", "H", "W"))
_EXPOSURE: dict[str, Any] = dict(
    view="uint", transforms=("real", "U", TRANSFORM_REALS), camera=("real", "J"),
    lens_of=("uint", "K"), lenses=("real", "L", "M"))
_EXPOSED = dict(exposed=("real", "F", "G", "I"))
_BACKGROUND: dict[str, Argument] = dict(background=("real", 3))
_LAYERS: dict[str, Argument] = dict(layers=("uchar", "N", "O", "Q"))
_CHECKPOINTS = dict(checkpoints=("real", "B", "X", 4), depth_checkpoints=("real", "C", "Y"))

BLEND = Kernel(
    "blend.cl", "blend",
    Forms(item=items("T"),
          group=groups("T", "TILE TILE", bucket_offsets=("uint", "T"), **_CHECKPOINTS)),
    **_SIZE, **_BACKGROUND, **_LISTS, **_SPLATS, **_IMAGE, **_ENDS, **_DEPTH, **_EXPOSURE,
    **_LAYERS, **_EXPOSED)
ADJOINT = Kernel(
    "blend.cl", "blend_adjoint",
    Forms(item=items("T", **_BACKGROUND, **_LAYERS),
          group=groups("B", "ADJOINT_GROUP", counts=("uint", FRAME_COUNTS),
                       bucket_offsets=("uint", "T"), bucket_tiles=("uint", "B"), **_IMAGE,
                       **_DEPTH, **_CHECKPOINTS)),
    **_SIZE, **_LISTS, emission_indices=("uint", "P"), **_SPLATS, **_ENDS,
    grad_image=("real", 3, "H", "W"), grad_depth=("real", "D", "E"),
    grad_transmittance=("real", "D", "E"), pair_grads=("real", "P", "S"))


class Vignetting(NamedTuple):
    """The gain of the lens of a frame's view (clsplat/response.py).

    Attributes
    ----------
    camera : real[27], packed.
    lens_of : uint[T], the lens of each view.
    lenses : real[L, 4].
    """

    camera: Array
    lens_of: Array
    lenses: Array


class Exposure(NamedTuple):
    """The response of the view of a frame.

    Attributes
    ----------
    transforms : real[T, 12], the colour transforms of views.
    view : the row of the frame's view.
    vignetting : None: no lens has any.
    """

    transforms: Array
    view: int
    vignetting: Vignetting | None = None


@dataclass(eq=False)
class Blended:
    """The result of blending.

    Attributes
    ----------
    image : real[3, H, W].
    exposed : real[3, H, W], the image with a view's response; None without one.
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
    exposed: Array | None = None
    checkpoints: Array | None = None
    depth_checkpoints: Array | None = None


@dataclass(frozen=True, eq=False)
class SplatGrads:
    """Gradients by splats: the sums over their pairs (cl/include/splat.h).

    Attributes
    ----------
    pair_grads : real[P, 9 or 10], by pair, in the order of emission.
    splat_counts, offsets : uint[V], how many pairs a splat has, and the first of them.
    earlier : real[V, 9 or 10], the sums over earlier bands; None: zero.
    """

    pair_grads: Array
    splat_counts: Array
    offsets: Array
    earlier: Array | None = None


def blend_defines(with_depth: bool, smooth_cutoff: bool = False, depth_percent: int = 0
                  ) -> Defines:
    """The build-time choices of both kernels; a depth at a share of the light has no adjoint."""
    choices = ("WITH_DEPTH", int(with_depth)), ("SMOOTH_CUTOFF", int(smooth_cutoff))
    return (*choices, ("DEPTH_PERCENT", depth_percent)) if with_depth and depth_percent else choices


def layer_defines(layers: Array | None) -> Defines:
    """The build-time choices that follow from layers uchar[3 or 7, H, W]; none without."""
    if layers is None:
        return ()
    return ("WITH_LAYERS", 1), ("WITH_FRONT", int(len(layers) == FRONT_AND_BACK_PLANES))


def bytes_or(token: Array, images: Array | None) -> Array:
    """uchar[C, H, W], or where there is none some other memory that is not read."""
    return token.viewed(np.uint8, 1, 1, token.nbytes) if images is None else images


def blend(device: Device, splats: Array, pairs: Pairs, width: int, height: int, background: Array,
          defines: Defines, result: Blended | None = None, exposure: Exposure | None = None,
          layers: Array | None = None) -> Blended:
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
    exposure : a response that is applied as well, the same for all bands.
    layers : uchar[3 or 7, H, W], what lies behind, in place of `background`, and in front, which
        only `exposed` shows (cl/include/layers.h); None: nothing.
    """
    with_depth = dict(defines)["WITH_DEPTH"]
    if result is None:
        depth_shape, image = (height, width) if with_depth else (1, 1), (3, height, width)
        result = Blended(device.empty(image), device.empty((height, width)),
                         device.empty((height, width), np.int32), device.empty(depth_shape),
                         device.empty(image) if exposure else None)
    nothing = result.depth.reshaped(1, *result.depth.shape)
    transforms, view, vignetting = exposure or Exposure(device.empty((1, TRANSFORM_REALS)), 0)
    camera, lens_of, lenses = vignetting or (background, pairs.counts, transforms)  # not read
    result.checkpoints = result.depth_checkpoints = None  # free those of the band before
    if pairs.bucket_tiles is not None:
        states = len(pairs.bucket_tiles), device.tile**2
        result.checkpoints = device.empty((*states, 4))
        result.depth_checkpoints = device.empty(states if with_depth else (1, 1))
    if layers is not None and layers.shape[1:] != (height, width):
        raise ShapeError(f"layers of {layers.shape[1:]} for an image of {(height, width)}")
    device.launch(BLEND, (*defines, *layer_defines(layers),
                          ("WITH_EXPOSURE", int(exposure is not None)),
                          ("WITH_VIGNETTING", int(vignetting is not None))),
                  width=width, height=height, tiles_x=pairs.tiles_x, first_tile=pairs.tiles.start,
                  background=background, ranges=pairs.ranges, sorted_splats=pairs.sorted_splats,
                  splats=splats, image=result.image, transmittance=result.transmittance,
                  last_contributor=result.last_contributor, depth=result.depth, view=view,
                  transforms=transforms, camera=camera, lens_of=lens_of, lenses=lenses,
                  layers=bytes_or(background, layers),
                  exposed=nothing if result.exposed is None else result.exposed,
                  bucket_offsets=pairs.bucket_offsets, checkpoints=result.checkpoints,
                  depth_checkpoints=result.depth_checkpoints)
    return result


def blend_adjoint(device: Device, splats: Array, pairs: Pairs, blended: Blended, background: Array,
                  grad_image: Array, grad_depth: Array, grad_transmittance: Array,
                  defines: Defines, earlier: Array | None = None, layers: Array | None = None
                  ) -> SplatGrads:
    """Gradients by splat from gradients by what `blend` made.

    Parameters
    ----------
    device, splats, pairs, background, defines, layers : as they were for `blend`.
    blended : what `blend` returned.
    grad_image : real[3, H, W].
    grad_depth, grad_transmittance : real[H, W], or tokens of 1 x 1 without the depth channel.
    earlier : real[V, 9 or 10], the sums over earlier bands; None: zero.
    """
    _, height, width = blended.image.shape
    columns = PAIR_SUMS + dict(defines)["WITH_DEPTH"]
    pair_grads = device.empty((pairs.count, columns))
    behind = layer_defines(layers)[:1] if READS_BACKGROUND.of(device) else ()
    device.launch(ADJOINT, (*defines, *behind), width=width, height=height, tiles_x=pairs.tiles_x,
                  first_tile=pairs.tiles.start, background=background,
                  layers=bytes_or(background, layers), ranges=pairs.ranges,
                  sorted_splats=pairs.sorted_splats, emission_indices=pairs.emission_indices,
                  splats=splats, image=blended.image, transmittance=blended.transmittance,
                  depth=blended.depth, last_contributor=blended.last_contributor,
                  grad_image=grad_image, grad_depth=grad_depth,
                  grad_transmittance=grad_transmittance, pair_grads=pair_grads,
                  counts=pairs.counts, bucket_offsets=pairs.bucket_offsets,
                  bucket_tiles=pairs.bucket_tiles,
                  checkpoints=blended.checkpoints, depth_checkpoints=blended.depth_checkpoints)
    return SplatGrads(pair_grads, pairs.splat_counts, pairs.offsets, earlier)
