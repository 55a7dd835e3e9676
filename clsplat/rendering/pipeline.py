"""The whole of rendering: gaussians to an image, and the image's gradient back to gaussians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from clsplat.camera import Camera
from clsplat.device import Array, ArraySpec, Device
from clsplat.primitives.gather import compact
from clsplat.primitives.sort import stable_sort
from clsplat.rendering.bands import choose_bands, pair_limit
from clsplat.rendering.bin import Pairs, TooManyPairs, bin_splats, count_tiles
from clsplat.rendering.blend import Blended, Defines, blend, blend_adjoint, blend_defines
from clsplat.rendering.project import Rows, cull, pack_camera, project, project_adjoint


@dataclass(eq=False)
class Frame:
    """A rendered image, and what its adjoint needs.

    Attributes
    ----------
    camera : real[27], packed.
    sh_degree : of the spherical harmonics that were used.
    visible : uint[V], rows of the gaussians that the camera sees, ascending.
    splats : real[V, 12], in the order of `visible` (cl/include/splat.h).
    order : uint[V], the splats front to back.
    pairs : of a frame in one band; those of several bands are not kept.
    bands : ranges of tiles; None is all tiles.
    pair_count : pairs of tile and splat in all bands.
    blended : the image, and its depth and transmittance.
    with_depth : whether there is a depth channel.
    """

    camera: Array
    sh_degree: int
    visible: Array
    splats: Array
    order: Array
    pairs: Pairs | None
    bands: tuple[range | None, ...]
    pair_count: int
    blended: Blended
    with_depth: bool

    @property
    def image(self) -> Array:
        """real[3, H, W]."""
        return self.blended.image

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.image.shape[2], self.image.shape[1]

    def pairs_of(self, band: range | None) -> Pairs:
        """The Pairs of one of `bands`: kept, or computed again."""
        width, height = self.size
        return self.pairs or bin_splats(
            self.splats.device, self.splats, self.order, width, height, band)


@dataclass(eq=False)
class Gradients:
    """Gradients of a loss by the V gaussians that a view saw.

    Attributes
    ----------
    fields : name -> real[V, *row shape]; of one view a `FieldGradients`, which computes those by
        the harmonics when they are asked for.
    means : real[V, 2], by the mean of the splat, pixels; None for a mean of several views.
    rows : uint[V], the row of each gaussian, or NO_ROW where the gradient is not finite.
    visible : uint[V], the row of each gaussian, whatever its gradient.
    """

    fields: Mapping[str, Array]
    means: Array | None
    rows: Array
    visible: Array


class Renderer:
    """Renders gaussians of one SH degree with one set of build-time choices.

    Parameters
    ----------
    device : the device of the gaussians' rows.
    sh_degree : of the stored spherical harmonics (SH).
    near : depth of the near plane, world units.
    antialiased : whether opacities are scaled by the area that the low-pass filter adds (Yu et al.
        2024, Mip-Splatting).
    background : red, green and blue.
    smooth_cutoff : for tests only (cl/include/footprint.h).
    pair_limit : pairs of tile and splat at a time; a frame that has more is rendered in bands, to
        the same bytes. None: as many as the device has memory for (bands.py).

    Attributes
    ----------
    skipped : uint[1], how many gradients of gaussians were not finite so far.
    """

    ARRAYS = ArraySpec((3,)), ArraySpec((1,), np.uint32), ArraySpec((1, 1))

    def __init__(self, device: Device, sh_degree: int, near: float, antialiased: bool = False,
                 background: Sequence[float] = (0.0, 0.0, 0.0), smooth_cutoff: bool = False,
                 pair_limit: int | None = None) -> None:
        self.device, self.near, self.smooth_cutoff = device, near, smooth_cutoff
        self.pair_limit = pair_limit
        self.background, self.skipped, self._token = (
            device.zeros(*spec) for spec in self.ARRAYS)
        self.background.write(background)
        self._project_defines = (("SH_REST", (sh_degree + 1) ** 2 - 1),
                                 ("ANTIALIASED", int(antialiased)))

    def pack(self, camera: Camera) -> Array:
        """The camera on the device, for `render`; pack once for each view, not in each step."""
        return pack_camera(self.device, camera, self.near)

    def render(self, rows: Rows, camera: Array, width: int, height: int, sh_degree: int,
               with_depth: bool = False) -> Frame:
        """Render gaussians from a camera.

        Parameters
        ----------
        rows : field name -> real[N, *row shape].
        camera : real[27], of `pack`.
        width, height : size of the image, pixels.
        sh_degree : of the spherical harmonics that are used, at most the stored ones.
        with_depth : whether the frame gets a depth channel.
        """
        device = self.device
        flags, depth_keys = cull(device, rows, camera, self._project_defines)
        visible_keys, visible = compact(device, flags, depth_keys)
        _, order = stable_sort(device, visible_keys)
        splats = project(device, rows, visible, camera, sh_degree, self._project_defines)
        limit = self.pair_limit
        if limit is None:
            limit = pair_limit(device, width, height, with_depth)
        pairs: Pairs | None = None
        bands: tuple[range | None, ...] = (None,)
        try:
            pairs = bin_splats(device, splats, order, width, height, limit=limit)
            pair_count = pairs.count
        except TooManyPairs:
            counts = count_tiles(device, splats, width, height)
            bands, pair_count = choose_bands(counts, limit), int(counts.sum())
        blended = None
        for band in bands:
            blended = blend(
                device, splats, pairs or bin_splats(device, splats, order, width, height, band),
                width, height, self.background, self._blend_defines(with_depth), blended)
        assert blended is not None  # an image has at least one band
        return Frame(camera, sh_degree, visible, splats, order, pairs, bands, pair_count, blended,
                     with_depth)

    def count(self, rows: Rows, camera: Array, width: int, height: int) -> tuple[int, int]:
        """How many splats and pairs `render` would have; neither sorts nor blends."""
        device = self.device
        visible = self._visible(rows, camera)
        splats = project(device, rows, visible, camera, 0, self._project_defines)
        return len(visible), int(count_tiles(device, splats, width, height).sum())

    def count_splats(self, rows: Rows, camera: Array) -> int:
        """How many splats `render` would have."""
        return len(self._visible(rows, camera))

    def _visible(self, rows: Rows, camera: Array) -> Array:
        flags, depth_keys = cull(self.device, rows, camera, self._project_defines)
        return compact(self.device, flags, depth_keys)[1]

    def adjoint(self, rows: Rows, frame: Frame, grad_image: Array,
                grad_depth: Array | None = None,
                grad_transmittance: Array | None = None) -> Gradients:
        """Gradients by the gaussians from gradients by a frame (backward pass).

        Parameters
        ----------
        rows : as they were for `render`.
        frame : what `render` returned.
        grad_image : real[3, H, W].
        grad_depth, grad_transmittance : real[H, W], for a frame with depth; None: zero.
        """
        device, zero = self.device, self._token
        if frame.with_depth and (grad_depth is None or grad_transmittance is None):
            zero = device.empty(frame.blended.depth.shape)
            zero.fill(0)
        grads = (grad_image, zero if grad_depth is None else grad_depth,
                 zero if grad_transmittance is None else grad_transmittance)
        splat_grads = None
        for band in frame.bands:
            splat_grads = self._add_band(frame, frame.pairs_of(band), grads, splat_grads)
        assert splat_grads is not None  # an image has at least one band
        fields, means, active = project_adjoint(
            device, rows, frame.visible, frame.camera, frame.sh_degree, self._project_defines,
            splat_grads, self.skipped)
        return Gradients(fields, means, active, frame.visible)

    def _add_band(self, frame: Frame, pairs: Pairs, grads: tuple[Array, Array, Array],
                  splat_grads: Array | None) -> Array:
        """The gradients of a band, added to those of the bands before."""
        device, defines = self.device, self._blend_defines(frame.with_depth)
        if pairs is not frame.pairs and pairs.bucket_tiles is not None:  # for the checkpoints
            width, height = frame.size
            blend(device, frame.splats, pairs, width, height, self.background, defines,
                  frame.blended)
        return blend_adjoint(device, frame.splats, pairs, frame.blended, self.background, *grads,
                             defines, splat_grads)

    def _blend_defines(self, with_depth: bool) -> Defines:
        return blend_defines(with_depth, self.smooth_cutoff)
