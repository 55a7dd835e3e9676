"""Blending of splats into an image, and its adjoint (cl/blend.cl); bands of tiles, one
after the other, for frames whose pairs of tile and splat do not fit into memory."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat import constants
from clsplat.device import Array, Device, Forms, Kernel, Only, groups, items
from clsplat.errors import DeviceError
from clsplat.rendering.bin import HAS_BUCKETS, PAIR_LIMIT, Pairs, tile_grid

MOST_CHANNELS = 16  # as local memory and the lanes of the group form's adjoint allow
FRAME_SHARE = 0.25  # of the device's memory; the rest is for parameters, moments and photos
BUFFER_SHARE = 2 / 3  # of the largest buffer: the pool rounds sizes up, by a quarter at most
INDEX_BYTES = 4
Defines = tuple[tuple[str, int], ...]  # names and values of the build-time choices of a kernel

_SIZE: dict[str, Any] = dict(width="int", height="int", first_tile="int")
_LISTS: dict[str, Any] = dict(ranges=("uint", "T", 2), sorted_splats=("uint", "P"))
_SPLATS: dict[str, Any] = dict(
    splats=("real", "V", constants.SPLAT_REALS),
    visible=Only("WITH_FEATURES", ("uint", "V")),
    features=Only("WITH_FEATURES", ("real", "N", "C")),
)
_ENDS: dict[str, Any] = dict(transmittance=("real", "H", "W"), last_contributor=("int", "H", "W"))
_IMAGE: dict[str, Any] = dict(image=("real", "C", "H", "W"))
_BACKGROUND: dict[str, Any] = dict(background=("real", "C"))
_DEPTH, _DEPTHS = (Only("WITH_DEPTH", ("real", *shape)) for shape in (("H", "W"), ("B", "X")))
# the response of a view: of kernels that include respond.h
RESPONSE: dict[str, Any] = dict(
    view=Only("WITH_RESPONSE", "uint"),
    transforms=Only("WITH_RESPONSE", ("real", "U", constants.TRANSFORM_REALS)),
    camera=Only("WITH_VIGNETTING", ("real", constants.CAMERA_REALS)),
    lens_of=Only("WITH_VIGNETTING", ("uint", "U")),
    lenses=Only("WITH_VIGNETTING", ("real", "L", constants.VIGNETTING_REALS)),
)

BLEND = Kernel(
    "blend.cl",
    "blend",
    Forms(
        item=items("T"),
        group=groups(
            "T",
            "TILE TILE",
            bucket_offsets=("uint", "T"),
            checkpoints=("real", "B", "X", "K"),
            depth_checkpoints=_DEPTHS,
        ),
    ),
    **_SIZE,
    **_BACKGROUND,
    **_LISTS,
    **_SPLATS,
    **_IMAGE,
    **_ENDS,
    depth=_DEPTH,
    **RESPONSE,
    exposed=Only("WITH_RESPONSE", ("real", 3, "H", "W")),
)
ADJOINT = Kernel(
    "blend.cl",
    "blend_adjoint",
    Forms(
        item=items("T", **_BACKGROUND),
        group=groups(
            "B",
            "ADJOINT_GROUP",
            counts=("uint", constants.FRAME_COUNTS),
            bucket_offsets=("uint", "T"),
            bucket_tiles=("uint", "B"),
            **_IMAGE,
            checkpoints=("real", "B", "X", "K"),
            depth=_DEPTH,
            depth_checkpoints=_DEPTHS,
        ),
    ),
    **_SIZE,
    **_LISTS,
    emission_indices=("uint", "P"),
    **_SPLATS,
    **_ENDS,
    grad_image=("real", "C", "H", "W"),
    grad_depth=_DEPTH,
    grad_transmittance=_DEPTH,
    pair_grads=("real", "P", "S"),
)


class Exposure(NamedTuple):
    """The response of the view of a frame (clsplat/response.py)."""

    transforms: Array  # real[T, 12], the colour transforms of views
    view: int  # the row of the frame's view
    # real[27], packed; this and the following are None if no lens has vignetting
    camera: Array | None = None
    lens_of: Array | None = None  # uint[T], the lens of each view
    lenses: Array | None = None  # real[L, 4], their vignetting


class Features(NamedTuple):
    """What is blended in place of the colours of gaussians."""

    rows: Array  # real[N, C], of all gaussians; C is 1 to MOST_CHANNELS
    visible: Array  # uint[V], the gaussian of each splat


@dataclass(eq=False)
class Blended:
    """The result of blending."""

    image: Array  # real[3, H, W]; of features real[C, H, W]
    transmittance: Array  # real[H, W], the share of the background that is visible
    # int[H, W], index in its band of the last pair that was blended, or a later one; -1 if there is
    # none. A frame in slabs has no such array
    last_contributor: Array | None
    depth_channel: Array | None  # real[H, W]; None without one
    # real[3, H, W], the image with a view's response; None without one
    exposed: Array | None = None
    # checkpoints, depth_checkpoints: of the band that was blended last; in the group form only
    checkpoints: Array | None = None
    depth_checkpoints: Array | None = None

    @property
    def depth(self) -> Array:
        """The depth channel of a frame that has one."""
        assert self.depth_channel is not None
        return self.depth_channel


@dataclass(frozen=True, eq=False)
class SplatGrads:
    """Gradients by splats: the sums over their pairs (cl/include/splat.h)."""

    pair_grads: Array  # real[P, S], by pair, in the order of emission; S of `pair_columns`
    # splat_counts, offsets: uint[V], how many pairs a splat has, and the first of them
    splat_counts: Array
    offsets: Array
    defines: Defines  # the choices on which S depends
    earlier: Array | None = None  # real[V, S], the sums over earlier bands; None: zero


def pair_columns(channels: int, with_depth: bool) -> int:
    """The numbers that the adjoint leaves of a pair of a tile and a splat (cl/include/splat.h)."""
    return constants.SHAPE_SUMS + max(channels, 2) + with_depth


def blend_defines(with_depth: bool, smooth_cutoff: bool = False, depth_percent: int = 0) -> Defines:
    """The build-time choices of both kernels; a depth at a share of the light has no adjoint."""
    return (
        ("WITH_DEPTH", int(with_depth)),
        ("SMOOTH_CUTOFF", int(smooth_cutoff)),
        ("DEPTH_PERCENT", depth_percent if with_depth else 0),
    )


def _of_features(features: Features | None) -> tuple[Defines, dict[str, Array | None]]:
    """The build-time choices and the arguments that follow from features."""
    if features is None:
        return (), {"visible": None, "features": None}
    return (
        (("WITH_FEATURES", 1), ("CHANNELS", features.rows.shape[1])),
        {"visible": features.visible, "features": features.rows},
    )


def response_defines(with_vignetting: bool) -> Defines:
    """The build-time choices of kernels that include respond.h, with a response; without one
    `blend` and its adjoint have the same, so that they are compiled together."""
    return ("WITH_RESPONSE", 1), ("WITH_VIGNETTING", int(with_vignetting))


def blend(
    device: Device,
    splats: Array,
    pairs: Pairs,
    width: int,
    height: int,
    background: Array,
    defines: Defines,
    result: Blended | None = None,
    exposure: Exposure | None = None,
    features: Features | None = None,
) -> Blended:
    """Blend splats over a background.

    Parameters
    ----------
    splats : real[V, 12] (cl/include/splat.h).
    pairs : those of the frame, or of a band of it.
    width, height : size of the image, pixels.
    background : real[3]; of features real[C].
    defines : of `blend_defines`.
    result : that of the bands before, to which the tiles of this one are added; None: a new one.
    exposure : a response that is applied as well, the same for all bands.
    features : blended in place of the colours; without an exposure.
    """
    with_depth, channels = dict(defines)["WITH_DEPTH"], len(background)
    if result is None:
        image = channels, height, width
        result = Blended(
            device.empty(image),
            device.empty((height, width)),
            device.empty((height, width), np.int32),
            device.empty((height, width)) if with_depth else None,
            device.empty(image) if exposure else None,
        )
    response = exposure._asdict() if exposure else dict.fromkeys(Exposure._fields)
    result.checkpoints = result.depth_checkpoints = None  # free those of the band before
    if pairs.bucket_tiles is not None:
        states = len(pairs.bucket_tiles), device.tile**2
        result.checkpoints = device.empty((*states, channels + 1))
        result.depth_checkpoints = device.empty(states) if with_depth else None
    choices, arguments = _of_features(features)
    responding = response_defines(exposure.lenses is not None) if exposure else ()
    device.launch(
        BLEND,
        (*defines, *choices, *responding),
        width=width,
        height=height,
        first_tile=pairs.tiles.start,
        background=background,
        ranges=pairs.ranges,
        sorted_splats=pairs.sorted_splats,
        splats=splats,
        **arguments,
        image=result.image,
        transmittance=result.transmittance,
        last_contributor=result.last_contributor,
        depth=result.depth_channel,
        **response,
        exposed=result.exposed,
        bucket_offsets=pairs.bucket_offsets,
        checkpoints=result.checkpoints,
        depth_checkpoints=result.depth_checkpoints,
    )
    return result


def blend_adjoint(
    device: Device,
    splats: Array,
    pairs: Pairs,
    blended: Blended,
    background: Array,
    grad_image: Array,
    grad_depth: Array | None,
    grad_transmittance: Array | None,
    defines: Defines,
    earlier: Array | None = None,
    features: Features | None = None,
) -> SplatGrads:
    """Gradients by splat from gradients by what `blend` made.

    Parameters
    ----------
    device, splats, pairs, background, defines, features : as they were for `blend`.
    blended : what `blend` returned.
    grad_image : of the shape of the image.
    grad_depth, grad_transmittance : real[H, W]; None without the depth channel.
    earlier : real[V, S], the sums over earlier bands; None: zero.
    """
    channels, height, width = blended.image.shape
    with_depth = dict(defines)["WITH_DEPTH"]
    pair_grads = device.empty((pairs.count, pair_columns(channels, bool(with_depth))))
    choices, arguments = _of_features(features)
    device.launch(
        ADJOINT,
        (*defines, *choices),
        width=width,
        height=height,
        first_tile=pairs.tiles.start,
        background=background,
        ranges=pairs.ranges,
        sorted_splats=pairs.sorted_splats,
        emission_indices=pairs.emission_indices,
        splats=splats,
        **arguments,
        image=blended.image,
        transmittance=blended.transmittance,
        depth=blended.depth_channel,
        last_contributor=blended.last_contributor,
        grad_image=grad_image,
        grad_depth=grad_depth,
        grad_transmittance=grad_transmittance,
        pair_grads=pair_grads,
        counts=pairs.counts,
        bucket_offsets=pairs.bucket_offsets,
        bucket_tiles=pairs.bucket_tiles,
        checkpoints=blended.checkpoints,
        depth_checkpoints=blended.depth_checkpoints,
    )
    return SplatGrads(pair_grads, pairs.splat_counts, pairs.offsets, (("WITH_DEPTH", with_depth), *choices), earlier)


def choose_bands(counts: NDArray[np.int64], limit: int) -> tuple[range, ...]:
    """Divide the tiles of a frame into as few bands as possible: ranges, numbered row by row.

    Tiles are blended independently, so the image has the bytes of a frame in one piece. A splat's
    pairs are emitted in the order of its tiles, and each band continues the gradient sums where the
    band before it ended, so the gradients have the same bytes too.

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
        raise DeviceError(
            f"{counts.max()} pairs of tile and splat in a single tile, more than "
            f"{limit}: use fewer gaussians (--max-gaussians)"
        )
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
    indices: reals for the gradients of each pair, and its share of a bucket's checkpoints."""
    grads = pair_columns(3, with_depth)
    checkpoints = HAS_BUCKETS.of(device) * (4 + with_depth) * device.tile**2 // device.bucket
    real, (tiles_x, tiles_y) = device.real.itemsize, tile_grid(device, width, height)
    # each tile may have a partial bucket
    spare = device.bucket * tiles_x * tiles_y if checkpoints else 0
    at_once = FRAME_SHARE * device.memory_limit / (2 * INDEX_BYTES + (grads + checkpoints) * real)
    in_a_buffer = BUFFER_SHARE * device.largest_buffer / (max(grads, checkpoints) * real)
    return min(PAIR_LIMIT, int(min(at_once, in_a_buffer)) - spare)
