"""The whole of rendering: gaussians to an image, and the image's gradient back to gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device import Array, Device
from clsplat.errors import ShapeError
from clsplat.primitives.compact import compact, new_counts
from clsplat.primitives.sort import stable_sort
from clsplat.rendering.bin import (
    NEEDS_ORDER,
    PAIR_LIMIT,
    Pairs,
    TooManyPairs,
    bin_splats,
    count_tiles,
)
from clsplat.rendering.blend import (
    MOST_CHANNELS,
    Blended,
    Defines,
    Exposure,
    Features,
    SplatGrads,
    blend,
    blend_adjoint,
    blend_defines,
    choose_bands,
    pair_limit,
)
from clsplat.rendering.cull import cull
from clsplat.rendering.project import (
    LOW_PASS,
    Gradients,
    Rows,
    pack_camera,
    project,
    project_adjoint,
    project_defines,
    sum_pairs,
)

Bands = tuple[range | None, ...]  # ranges of tiles; None is all tiles


@dataclass(frozen=True)
class Room:
    """The sizes of a frame's arrays, where only the device knows how much of them is used.

    Attributes
    ----------
    visible : gaussians that a view may see.
    pairs : pairs of tile and splat that a band may have.
    bands : of the frame.
    """

    visible: int
    pairs: int
    bands: Bands = (None,)


@dataclass(eq=False)
class Frame:
    """A rendered image, and what its adjoint needs.

    Attributes
    ----------
    camera : real[27], packed.
    sh_degree : of the spherical harmonics that were used.
    counts : uint[FRAME_COUNTS], the numbers of the frame (clsplat/constants.py).
    visible : uint[V], rows of the gaussians that the camera sees, ascending.
    splats : real[V, 12], in the order of `visible` (cl/include/splat.h).
    order : uint[V], the splats front to back; in the item form only.
    pairs : of a frame in one band; those of several bands are not kept.
    bands : the ranges of tiles that are blended one after the other.
    room : None, or the sizes of the arrays, which then may be larger than V and the number of
        pairs.
    blended : the image, and its depth and transmittance.
    with_depth : whether there is a depth channel.
    features : what was blended in place of the colours; None: the colours were.
    """

    camera: Array
    sh_degree: int
    counts: Array
    visible: Array
    splats: Array
    order: Array | None
    pairs: Pairs | None
    bands: Bands
    room: Room | None
    blended: Blended
    with_depth: bool
    features: Features | None = None

    @property
    def image(self) -> Array:
        """real[3, H, W]; of features real[C, H, W]."""
        return self.blended.image

    @property
    def exposed(self) -> Array:
        """real[3, H, W], the image with a response where one was given."""
        return self.image if self.blended.exposed is None else self.blended.exposed

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.image.shape[2], self.image.shape[1]

    def pairs_of(self, band: range | None) -> Pairs:
        """The Pairs of one of `bands`: kept, or computed again."""
        width, height = self.size
        return self.pairs or bin_splats(
            self.splats.device, self.splats, self.counts, self.order, width, height, band,
            room=self.room.pairs if self.room else None)


class Renderer:
    """Renders gaussians of one SH degree with one set of build-time choices.

    Parameters
    ----------
    sh_degree : of the stored spherical harmonics (SH).
    near : depth of the near plane, world units.
    antialiased : whether opacities are scaled by the area that the low-pass filter adds (Yu et al.
        2024, Mip-Splatting).
    background : red, green and blue.
    orthographic : whether its cameras are; such frames have no adjoint.
    depth_percent : the depth channel is the depth at which the transmittance falls to so many per
        cent, in place of the sum of weight times depth, which 0 is; such frames have no adjoint.
    low_pass : added to the variances of a splat, pixels squared.
    smooth_cutoff : for tests only (cl/include/footprint.h).
    pair_limit : pairs of tile and splat at a time; a frame that has more is rendered in bands, to
        the same bytes. None: as many as the device has memory for (blend.py).

    Attributes
    ----------
    skipped : uint[1], how many gradients of gaussians were not finite so far.
    """

    def __init__(self, device: Device, sh_degree: int, near: float, antialiased: bool = False,
                 background: Sequence[float] = (0.0, 0.0, 0.0), smooth_cutoff: bool = False,
                 pair_limit: int | None = None, orthographic: bool = False,
                 depth_percent: int = 0, low_pass: float = LOW_PASS) -> None:
        self.device, self.near, self.smooth_cutoff = device, near, smooth_cutoff
        self.orthographic, self.depth_percent = orthographic, depth_percent
        self.low_pass = low_pass
        self.pair_limit = pair_limit
        self.background, self.skipped = device.zeros((3,)), device.zeros((1,), np.uint32)
        self.background.write(background)
        self._zeros: dict[int, Array] = {}  # number of channels -> the background of features
        self._project_defines = project_defines(sh_degree, antialiased, orthographic)

    def pack(self, camera: Camera) -> Array:
        """The camera on the device, for `render`; pack once for each view, not in each step."""
        if camera.orthographic != self.orthographic:
            raise ValueError("a renderer is for orthographic cameras, or for pinhole cameras")
        return pack_camera(self.device, camera, self.near, self.low_pass)

    def at_percent(self, depth_percent: int) -> Renderer:
        """The same renderer for another `depth_percent`."""
        other = copy(self)
        other.depth_percent = depth_percent
        return other

    def render(self, rows: Rows, camera: Array, width: int, height: int, sh_degree: int,
               with_depth: bool = False, room: Room | None = None, counts: Array | None = None,
               exposure: Exposure | None = None, features: Array | None = None) -> Frame:
        """Render gaussians from a camera.

        Parameters
        ----------
        rows : field name -> real[N, *row shape].
        camera : real[27], of `pack`.
        width, height : size of the image, pixels.
        sh_degree : of the spherical harmonics that are used, at most the stored ones.
        with_depth : whether the frame gets a depth channel.
        room : sizes of the frame's arrays, so that nothing waits for the device; a frame for which
            they are too small fails (cl/include/counts.h). None: exact sizes; waits twice.
        counts : uint[FRAME_COUNTS], for a frame with a room; its sums and its failure go on.
        exposure : a response, with which the frame also is `exposed`.
        features : real[N, C], blended over zeros in place of the colours, so that the image is
            real[C, H, W]; C is 1 to MOST_CHANNELS. Without an exposure.
        """
        device = self.device
        counts = new_counts(device) if counts is None else counts
        if features is not None:
            if exposure is not None:
                raise ValueError("features have no exposure")
            if not 1 <= features.shape[1] <= MOST_CHANNELS:
                raise ShapeError(f"features have 1 to {MOST_CHANNELS} channels, not "
                                 f"{features.shape[1]}")
            sh_degree = 0  # colours are not drawn
        visible = self._visible(rows, camera, counts, room)
        splats, depth_keys = project(device, rows, visible, counts, camera, sh_degree,
                                     self._project_defines)
        order = stable_sort(device, depth_keys, counts)[1] if NEEDS_ORDER.of(device) else None

        def binned(band: range | None, limit: int = PAIR_LIMIT) -> Pairs:
            return bin_splats(device, splats, counts, order, width, height, band, limit,
                              room.pairs if room else None)

        pairs, bands = None, room.bands if room else (None,)
        if bands == (None,):
            limit = self.most_pairs(width, height, with_depth)
            try:
                pairs = binned(None, limit)
            except TooManyPairs:
                bands = choose_bands(count_tiles(device, splats, counts, width, height), limit)
        blended, of_visible = None, None if features is None else Features(features, visible)
        for band in bands:
            blended = blend(device, splats, pairs or binned(band), width, height,
                            self._background(of_visible), self._blend_defines(with_depth),
                            blended, exposure, of_visible)
        assert blended is not None  # an image has at least one band
        return Frame(camera, sh_degree, counts, visible, splats, order, pairs, bands, room, blended,
                     with_depth, of_visible)

    def most_pairs(self, width: int, height: int, with_depth: bool) -> int:
        """The largest number of pairs that a band of a frame may have."""
        if self.pair_limit is not None:
            return self.pair_limit
        return pair_limit(self.device, width, height, with_depth)

    def measure(self, rows: Rows, camera: Array, width: int, height: int
                ) -> tuple[int, NDArray[np.int64]]:
        """How many splats `render` would have, and how many pairs in each tile; waits.

        It neither sorts nor blends.
        """
        device, counts = self.device, new_counts(self.device)
        visible = self._visible(rows, camera, counts)
        splats, _ = project(device, rows, visible, counts, camera, 0, self._project_defines)
        return len(visible), count_tiles(device, splats, counts, width, height)

    def count_splats(self, rows: Rows, camera: Array) -> int:
        """How many splats `render` would have."""
        return len(self._visible(rows, camera, new_counts(self.device)))

    def _visible(self, rows: Rows, camera: Array, counts: Array, room: Room | None = None) -> Array:
        flags, totals = cull(self.device, rows, camera, self._project_defines)
        return compact(self.device, flags, counts, room.visible if room else None, totals)

    def adjoint(self, rows: Rows, frame: Frame, grad_image: Array,
                grad_depth: Array | None = None,
                grad_transmittance: Array | None = None, frozen: Array | None = None,
                statistics: tuple[Array, Array] | None = None, masked: Array | None = None,
                with_pose: bool = False) -> Gradients:
        """Gradients by the gaussians from gradients by a frame (backward pass).

        Parameters
        ----------
        rows : as they were for `render`.
        frame : what `render` returned.
        grad_image : of the shape of the image.
        grad_depth, grad_transmittance : real[H, W], for a frame with depth; None: zero.
        frozen, statistics, masked, with_pose : as for `project_adjoint`.
        """
        if self.orthographic or self.depth_percent:
            raise ValueError("orthographic frames and depths at some light have no adjoint")
        device, zero = self.device, None
        if frame.with_depth and (grad_depth is None or grad_transmittance is None):
            zero = device.empty(frame.image.shape[1:])
            zero.fill(0)
        grads = (grad_image, zero if grad_depth is None else grad_depth,
                 zero if grad_transmittance is None else grad_transmittance)
        earlier, (*before, last) = None, frame.bands  # an image has at least one band
        for band in before:
            earlier = sum_pairs(
                device, self._splat_grads(frame, frame.pairs_of(band), grads, earlier),
                frame.counts, self._project_defines)
        splat_grads = self._splat_grads(frame, frame.pairs_of(last), grads, earlier)
        return project_adjoint(
            device, rows, frame.visible, frame.counts, frame.camera, frame.sh_degree,
            self._project_defines, splat_grads, self.skipped, frame.size, frozen, statistics,
            masked, with_pose)

    def _splat_grads(self, frame: Frame, pairs: Pairs,
                     grads: tuple[Array, Array | None, Array | None],
                     earlier: Array | None) -> SplatGrads:
        """The gradients of a band, after those of earlier bands."""
        device, defines = self.device, self._blend_defines(frame.with_depth)
        background = self._background(frame.features)
        if pairs is not frame.pairs and pairs.bucket_tiles is not None:  # for the checkpoints
            width, height = frame.size
            blend(device, frame.splats, pairs, width, height, background, defines,
                  frame.blended, features=frame.features)
        return blend_adjoint(device, frame.splats, pairs, frame.blended, background, *grads,
                             defines, earlier, frame.features)

    def _background(self, features: Features | None) -> Array:
        """The background: real[3], or of features real[C] of zeros."""
        if features is None:
            return self.background
        channels = features.rows.shape[1]
        if channels not in self._zeros:
            self._zeros[channels] = self.device.zeros((channels,))
        return self._zeros[channels]

    def _blend_defines(self, with_depth: bool) -> Defines:
        return blend_defines(with_depth, self.smooth_cutoff, self.depth_percent)
