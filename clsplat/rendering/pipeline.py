"""The whole of rendering: gaussians to an image, and the image's gradient back to gaussians."""

from dataclasses import dataclass

import numpy as np

from clsplat.device import Array, ArraySpec
from clsplat.primitives.gather import compact
from clsplat.primitives.sort import stable_sort
from clsplat.rendering.bands import choose_bands, pair_limit
from clsplat.rendering.bin import Pairs, TooManyPairs, bin_splats, count_tiles
from clsplat.rendering.blend import Blended, blend, blend_adjoint, blend_defines
from clsplat.rendering.project import cull, pack_camera, project, project_adjoint


@dataclass(eq=False)
class Frame:
    """What a render leaves for its adjoint. visible: uint[V], rows of the gaussians seen,
    ascending; splats: real[V, 12], in that order; order: uint[V], front to back; bands: ranges of
    tiles, or None, which stands for all. Only the pairs of a frame in one band are kept."""

    camera: Array
    degree: int
    visible: Array
    splats: Array
    order: Array
    pairs: Pairs | None
    bands: tuple
    pair_count: int
    blended: Blended
    with_depth: bool

    @property
    def image(self):
        return self.blended.image

    @property
    def size(self):
        """(width, height), pixels."""
        return self.image.shape[2], self.image.shape[1]

    def pairs_of(self, band):
        """The Pairs of one of `bands`: kept, or found again."""
        return self.pairs or bin_splats(
            self.splats.device, self.splats, self.order, *self.size, band)


@dataclass(eq=False)
class Gradients:
    """Gradients of a loss by the rows that a view saw.

    fields: name -> real[V, *row shape]; means: real[V, 2], by the splat's mean, pixels; rows:
    uint[V], the gaussian of each, or NO_ROW where a gradient was not finite; visible: uint[V],
    the gaussian of each, whatever its gradient.
    """

    fields: dict[str, Array]
    means: Array
    rows: Array
    visible: Array


class Renderer:
    """Renders gaussians of one SH degree with one set of build-time choices.

    antialiased: scale opacity by the area that the low-pass adds (Yu et al. 2024, Mip-Splatting).
    near: world units. background: three numbers. smooth_cutoff: tests only
    (cl/include/footprint.h). pair_limit: pairs of tile and splat at a time; a frame that has more
    is rendered in bands, to the same bytes. None: what the device has room for (bands.py).
    """

    ARRAYS = ArraySpec((3,)), ArraySpec((1,), np.uint32), ArraySpec((1, 1))

    def __init__(self, device, sh_degree, near, antialiased=False, background=(0.0, 0.0, 0.0),
                 smooth_cutoff=False, pair_limit=None):
        self.device, self.near, self.smooth_cutoff = device, near, smooth_cutoff
        self.pair_limit = pair_limit
        self.background, self.skipped, self._token = (
            device.zeros(*spec) for spec in self.ARRAYS)
        self.background.write(background)
        self._project_defines = (("SH_REST", (sh_degree + 1) ** 2 - 1),
                                 ("ANTIALIASED", int(antialiased)))

    def pack(self, camera):
        """The camera on the device, for `render`; pack once a view, not once a step."""
        return pack_camera(self.device, camera, self.near)

    def render(self, rows, camera, width, height, degree, with_depth=False):
        """Render rows (field name -> real[N, ...]) with a packed camera; returns a Frame."""
        device = self.device
        flags, depth_keys = cull(device, rows, camera, self._project_defines)
        visible_keys, visible = compact(device, flags, depth_keys)
        _, order = stable_sort(device, visible_keys)
        splats = project(device, rows, visible, camera, degree, self._project_defines)
        limit = self.pair_limit
        if limit is None:
            limit = pair_limit(device, width, height, with_depth)
        try:
            pairs, bands = bin_splats(device, splats, order, width, height, limit=limit), (None,)
            pair_count = pairs.count
        except TooManyPairs:
            counts = count_tiles(device, splats, width, height)
            pairs, bands, pair_count = None, choose_bands(counts, limit), int(counts.sum())
        blended = None
        for band in bands:
            blended = blend(
                device, splats, pairs or bin_splats(device, splats, order, width, height, band),
                width, height, self.background, self._blend_defines(with_depth), blended)
        return Frame(camera, degree, visible, splats, order, pairs, bands, pair_count, blended,
                     with_depth)

    def count(self, rows, camera, width, height):
        """(splats, pairs) that `render` would find; neither sorts nor blends."""
        device = self.device
        visible = self._visible(rows, camera)
        splats = project(device, rows, visible, camera, 0, self._project_defines)
        return len(visible), int(count_tiles(device, splats, width, height).sum())

    def count_splats(self, rows, camera):
        """The splats alone."""
        return len(self._visible(rows, camera))

    def _visible(self, rows, camera):
        flags, depth_keys = cull(self.device, rows, camera, self._project_defines)
        return compact(self.device, flags, depth_keys)[1]

    def adjoint(self, rows, frame, grad_image, grad_depth=None, grad_transmittance=None):
        """Gradients from grad_image real[3, H, W] and, for a frame with depth, from grad_depth and
        grad_transmittance real[H, W], by the depth channel and by what is left of the light."""
        device, none = self.device, self._token
        if frame.with_depth and (grad_depth is None or grad_transmittance is None):
            none = device.empty(frame.blended.depth.shape)
            none.fill(0)
        grads = (grad_image, none if grad_depth is None else grad_depth,
                 none if grad_transmittance is None else grad_transmittance)
        sums = None
        for band in frame.bands:
            sums = self._add_band(frame, frame.pairs_of(band), grads, sums)
        return Gradients(*project_adjoint(
            device, rows, frame.visible, frame.camera, frame.degree, self._project_defines, sums,
            self.skipped), frame.visible)

    def _add_band(self, frame, pairs, grads, sums):
        """The sums of a band added to those of earlier ones."""
        device, defines = self.device, self._blend_defines(frame.with_depth)
        if pairs is not frame.pairs and pairs.bucket_tiles is not None:  # for the checkpoints
            blend(device, frame.splats, pairs, *frame.size, self.background, defines, frame.blended)
        return blend_adjoint(device, frame.splats, pairs, frame.blended, self.background, *grads,
                             defines, sums)

    def _blend_defines(self, with_depth):
        return blend_defines(with_depth, self.smooth_cutoff)
