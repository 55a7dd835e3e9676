"""The whole of rendering: gaussians to an image, and the image's gradient back to gaussians."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device import Array, Device
from clsplat.errors import ShapeError
from clsplat.primitives.compact import compact, new_counts
from clsplat.primitives.sort import stable_sort
from clsplat.rendering import bin, blend, project
from clsplat.rendering.cull import cull
from clsplat.rendering.ray_depth import MOST_NUMBERED, number_splats, ray_depth

Bands = tuple[range | None, ...]  # ranges of tiles; None is all tiles


@dataclass(frozen=True)
class Room:
    """The sizes of a frame's arrays, where only the device knows how much of them is used."""

    visible: int  # gaussians that a view may see
    pairs: int  # pairs of tile and splat that a band may have
    bands: Bands = (None,)  # of the frame


@dataclass(eq=False)
class Frame:
    """A rendered image, and what its adjoint needs."""

    camera: Array  # real[27], packed
    sh_degree: int  # of the spherical harmonics that were used
    counts: Array  # uint[FRAME_COUNTS], the numbers of the frame (clsplat/constants.py)
    visible: Array  # uint[V], rows of the gaussians that the camera sees, ascending
    splats: Array  # real[V, 12], in the order of `visible` (cl/include/splat.h)
    order: Array | None  # uint[V], the splats front to back; in the item form only
    pairs: bin.Pairs | None  # of a frame in one band; those of several bands are not kept
    bands: Bands  # the ranges of tiles that are blended one after the other
    # None, or the sizes of the arrays, which then may be larger than V and the number of pairs
    room: Room | None
    blended: blend.Blended  # the image, and its depth and transmittance
    # with_depth, depth_percent: as they were for `Renderer.render`
    with_depth: bool
    depth_percent: int
    # what was blended in place of the colours; None: the colours were
    features: blend.Features | None = None

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

    def pairs_of(self, band: range | None) -> bin.Pairs:
        """The Pairs of one of `bands`: kept, or computed again."""
        width, height = self.size
        return self.pairs or bin.bin_splats(
            self.splats.device,
            self.splats,
            self.counts,
            self.order,
            width,
            height,
            band,
            room=self.room.pairs if self.room else None,
        )


class Renderer:
    """Renders gaussians of one SH degree with one set of build-time choices.

    Parameters
    ----------
    sh_degree : of the stored spherical harmonics (SH).
    near : depth of the near plane, world units.
    antialiased : whether opacities are scaled by the area that the low-pass filter adds (Yu et al.
        2024, Mip-Splatting).
    orthographic : whether its cameras are; such frames have no adjoint.
    low_pass : added to the variances of a splat, pixels squared.
    smooth_cutoff : for tests only (cl/include/footprint.h).
    """

    def __init__(
        self,
        device: Device,
        sh_degree: int,
        near: float,
        antialiased: bool = False,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        smooth_cutoff: bool = False,
        orthographic: bool = False,
        low_pass: float = project.LOW_PASS,
    ) -> None:
        self.device, self.near, self.smooth_cutoff = device, near, smooth_cutoff
        self.orthographic, self.low_pass = orthographic, low_pass
        self.background, self.skipped = device.zeros((3,)), device.zeros((1,), np.uint32)
        self.background.write(background)
        self._project_defines = project.project_defines(sh_degree, antialiased, orthographic)

    def pack(self, camera: Camera) -> Array:
        """The camera on the device, for `render`; pack once for each view, not in each step."""
        if camera.orthographic != self.orthographic:
            raise ValueError("a renderer is for orthographic cameras, or for pinhole cameras")
        return project.pack_camera(self.device, camera, self.near, self.low_pass)

    def render(
        self,
        rows: project.Rows,
        camera: Array,
        width: int,
        height: int,
        sh_degree: int,
        with_depth: bool = False,
        room: Room | None = None,
        counts: Array | None = None,
        exposure: blend.Exposure | None = None,
        features: Array | None = None,
        depth_percent: int = 0,
    ) -> Frame:
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
        depth_percent : the depth channel is the depth at which a pixel's ray passes the gaussian
            where the transmittance falls to so many per cent (ray_depth.py), in place of the sum of
            weight times depth, which 0 is; such frames have no adjoint.
        """
        device = self.device
        counts = new_counts(device) if counts is None else counts
        if features is not None:
            if exposure is not None:
                raise ValueError("features have no exposure")
            if not 1 <= features.shape[1] <= blend.MOST_CHANNELS:
                raise ShapeError(f"features have 1 to {blend.MOST_CHANNELS} channels, not {features.shape[1]}")
            sh_degree = 0  # colours are not drawn
        visible = self.visible(rows, camera, counts, room)
        splats, depth_keys = project.project(device, rows, visible, counts, camera, sh_degree, self._project_defines)
        order = stable_sort(device, depth_keys, counts)[1] if bin.NEEDS_ORDER.of(device) else None
        numbered = None
        if with_depth and depth_percent and len(visible) <= MOST_NUMBERED:
            numbered = number_splats(device, splats, self._project_defines)

        def binned(band: range | None, limit: int = bin.PAIR_LIMIT) -> bin.Pairs:
            return bin.bin_splats(
                device, splats, counts, order, width, height, band, limit, room.pairs if room else None
            )

        pairs, bands = None, room.bands if room else (None,)
        if bands == (None,):
            limit = self.most_pairs(width, height, with_depth)
            try:
                pairs = binned(None, limit)
            except bin.TooManyPairs:
                bands = blend.choose_bands(bin.count_tiles(device, splats, counts, width, height), limit)
        blended, of_visible = None, None if features is None else blend.Features(features, visible)
        defines = blend.blend_defines(with_depth, self.smooth_cutoff, depth_percent)
        for band in bands:
            blended = blend.blend(
                device,
                splats if numbered is None else numbered,
                pairs or binned(band),
                width,
                height,
                self._background(of_visible),
                defines,
                blended,
                exposure,
                of_visible,
            )
        assert blended is not None  # an image has at least one band
        if numbered is not None:
            ray_depth(device, rows, visible, camera, blended.depth, self._project_defines)
        return Frame(
            camera,
            sh_degree,
            counts,
            visible,
            splats,
            order,
            pairs,
            bands,
            room,
            blended,
            with_depth,
            depth_percent,
            of_visible,
        )

    def most_pairs(self, width: int, height: int, with_depth: bool) -> int:
        """The largest number of pairs that a band of a frame may have; a frame that has more is
        rendered in bands, to the same bytes."""
        return blend.pair_limit(self.device, width, height, with_depth)

    def measure(self, rows: project.Rows, camera: Array, width: int, height: int) -> tuple[int, NDArray[np.int64]]:
        """How many splats `render` would have, and how many pairs in each tile; waits.

        It neither sorts nor blends.
        """
        device, counts = self.device, new_counts(self.device)
        visible = self.visible(rows, camera, counts)
        splats, _ = project.project(device, rows, visible, counts, camera, 0, self._project_defines)
        return len(visible), bin.count_tiles(device, splats, counts, width, height)

    def visible(
        self, rows: project.Rows, camera: Array, counts: Array | None = None, room: Room | None = None
    ) -> Array:
        """uint[V], the rows of the gaussians that `render` would draw, ascending; waits without a
        room."""
        flags, totals = cull(self.device, rows, camera, self._project_defines)
        return compact(
            self.device,
            flags,
            new_counts(self.device) if counts is None else counts,
            room.visible if room else None,
            totals,
        )

    def adjoint(
        self,
        rows: project.Rows,
        frame: Frame,
        grad_image: Array,
        grad_depth: Array | None = None,
        grad_transmittance: Array | None = None,
        frozen: Array | None = None,
        statistics: tuple[Array, Array] | None = None,
        masked: Array | None = None,
        with_pose: bool = False,
    ) -> project.Gradients:
        """Gradients by the gaussians from gradients by a frame (backward pass).

        Parameters
        ----------
        rows : as they were for `render`.
        frame : what `render` returned.
        grad_image : of the shape of the image.
        grad_depth, grad_transmittance : real[H, W], for a frame with depth; None: zero.
        frozen, statistics, masked, with_pose : as for `project_adjoint`.
        """
        if self.orthographic or frame.depth_percent:
            raise ValueError("orthographic frames and depths at some light have no adjoint")
        device, zero = self.device, None
        if frame.with_depth and (grad_depth is None or grad_transmittance is None):
            zero = device.empty(frame.image.shape[1:])
            zero.fill(0)
        grads = (
            grad_image,
            zero if grad_depth is None else grad_depth,
            zero if grad_transmittance is None else grad_transmittance,
        )
        earlier, (*before, last) = None, frame.bands  # an image has at least one band
        for band in before:
            earlier = project.sum_pairs(
                device,
                self._splat_grads(frame, frame.pairs_of(band), grads, earlier),
                frame.counts,
                self._project_defines,
            )
        splat_grads = self._splat_grads(frame, frame.pairs_of(last), grads, earlier)
        return project.project_adjoint(
            device,
            rows,
            frame.visible,
            frame.counts,
            frame.camera,
            frame.sh_degree,
            self._project_defines,
            splat_grads,
            self.skipped,
            frame.size,
            frozen,
            statistics,
            masked,
            with_pose,
        )

    def _splat_grads(
        self, frame: Frame, pairs: bin.Pairs, grads: tuple[Array, Array | None, Array | None], earlier: Array | None
    ) -> blend.SplatGrads:
        """The gradients of a band, after those of earlier bands."""
        device, background = self.device, self._background(frame.features)
        defines = blend.blend_defines(frame.with_depth, self.smooth_cutoff)
        if pairs is not frame.pairs and pairs.bucket_tiles is not None:  # for the checkpoints
            width, height = frame.size
            blend.blend(
                device, frame.splats, pairs, width, height, background, defines, frame.blended, features=frame.features
            )
        return blend.blend_adjoint(
            device, frame.splats, pairs, frame.blended, background, *grads, defines, earlier, frame.features
        )

    def _background(self, features: blend.Features | None) -> Array:
        """The background: real[3], or of features real[C] of zeros."""
        if features is None:
            return self.background
        return self.device.zeros((features.rows.shape[1],))
