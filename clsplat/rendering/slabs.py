"""Frames of models larger than the device: slabs of depth, rendered front to back.

Rows stay in host memory. Bounding boxes of parts of them say which parts a view cannot see; in the
others `cull` finds, on the device, the gaussians that are drawn, and `project` their depth keys.
Sorted by key, ties by row, they are divided into slabs that fit. Each is rendered by itself and
composited behind the ones before it:

    C = C1 + T1 C2,  D = D1 + T1 D2,  T = T1 T2

The order is that of a frame in one piece, to the last tie. Only the end of a pixel differs:
blending stops before its transmittance would fall below TRANSMITTANCE_MIN, and each slab begins
with 1 again. So a slab may add what a frame in one piece leaves out. Its weight is below
TRANSMITTANCE_MIN / (1 - ALPHA_MAX) = 0.01 where almost opaque gaussians lie behind each other, and
mostly far smaller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import ALPHA_STEPS, SPLAT_REALS, TRANSMITTANCE_MIN
from clsplat.device import Array, Device
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.primitives.compact import new_counts
from clsplat.rendering.blend import BUFFER_SHARE, Blended
from clsplat.rendering.pipeline import Frame, Renderer
from clsplat.rendering.project import LOW_PASS, clamped_ratios, project, project_defines

MODEL_SHARE = 0.3  # of the device's memory for a model and its splats; two may be compared
INDICES = 6  # uints for each gaussian that culling and sorting need
PART_ROWS = 1 << 16  # rows that share a bounding box
CUTOFF = 2.01 * np.log(ALPHA_STEPS)  # squared distance: at least may_meet_image's of cl/cull.cl
ROUNDING = 1e-5  # share of a coordinate that float32 may lose on the way to a pixel
ROW = np.uint64(2**32 - 1)  # the bits of a row beside the key of its depth
CULL_FIELDS = ("positions", "log_scales", "quaternions", "opacity_logits")


class ModelRenderer(Protocol):
    """What `Renderer` and `SlabRenderer` have in common; each takes its own rows and cameras."""

    def pack(self, camera: Camera, /) -> Any:
        """The camera as `render` expects it."""

    def render(
        self,
        rows: Any,
        camera: Any,
        width: int,
        height: int,
        sh_degree: int,
        /,
        with_depth: bool = False,
        *,
        depth_percent: int = 0,
    ) -> Frame | SlabFrame:
        """Render the model from a packed camera."""


class SlabParts(Protocol):
    """What a SlabRenderer draws: fewer than 2^32 rows, as in `Parts`."""

    def seen(self, camera: Camera, near: float, low_pass: float = LOW_PASS, /) -> list[slice]:
        """Slices of the rows that a camera may see."""

    def read(self, name: str, rows: slice | NDArray[np.int64], /) -> NDArray[np.floating]:
        """A field of some rows."""


def gaussian_limit(device: Device, sh_degree: int) -> int:
    """The largest number of gaussians for which the device has memory at a time."""
    widths = [field.width(sh_degree) for field in LEARNED]
    real = device.real.itemsize
    room = MODEL_SHARE * device.handle.global_mem_size / (real * (sum(widths) + SPLAT_REALS) + 4 * INDICES)
    in_a_buffer = BUFFER_SHARE * device.largest_buffer / (real * max(*widths, SPLAT_REALS))
    return max(1, int(min(room, in_a_buffer)))


def open_model(
    device: Device,
    gaussians: Gaussians,
    near: float,
    antialiased: bool = False,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    orthographic: bool = False,
    low_pass: float = LOW_PASS,
) -> tuple[ModelRenderer, Any]:
    """Prepare finished gaussians for rendering.

    Parameters
    ----------
    device, near, antialiased, background, orthographic, low_pass : as for `pipeline.Renderer`.
    gaussians : the model, of any size.

    Returns
    -------
    A Renderer and rows on the device where these fit, otherwise a SlabRenderer and `Parts`.
    """
    settings = device, gaussians.sh_degree, near, antialiased, background
    limit = gaussian_limit(device, gaussians.sh_degree)
    if gaussians.count > limit:
        return SlabRenderer(*settings, limit, orthographic, low_pass), Parts.of(gaussians.rows)
    rows = {field.name: device.upload(gaussians.rows[field.name]) for field in LEARNED}
    return Renderer(*settings, orthographic=orthographic, low_pass=low_pass), rows


@dataclass(frozen=True, eq=False)
class Parts:
    """A model in host memory, in parts with bounding boxes."""

    rows: dict[str, NDArray[np.floating]]  # field name -> float[N, *row shape]
    firsts: NDArray[np.int64]  # int[P + 1], the first row of each part, and N
    # low, high: float64[P, 3], corners of the bounding box of the centres, world units
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    # float64[P], the largest standard deviation of a gaussian, world units
    scales: NDArray[np.float64]

    @classmethod
    def of(cls, rows: dict[str, NDArray[np.floating]], size: int = PART_ROWS) -> Parts:
        """Parts of `size` consecutive rows: in a merged model, these lie in the same block."""
        positions, largest = rows["positions"], rows["log_scales"].max(axis=1)
        firsts = np.arange(0, len(positions), size)
        low, high, scale = (
            end.reduceat(values, firsts).astype(np.float64)
            for end, values in ((np.minimum, positions), (np.maximum, positions), (np.maximum, largest))
        )
        return cls(rows, np.append(firsts, len(positions)), low, high, np.exp(scale))

    def seen(self, camera: Camera, near: float, low_pass: float = LOW_PASS) -> list[slice]:
        """Slices of the rows that a camera may see; all that `cull` would draw is in one."""
        seen = boxes_seen(self.low, self.high, self.scales, camera, near, low_pass)
        return [slice(*self.firsts[part : part + 2]) for part in np.flatnonzero(seen)]

    def read(self, name: str, rows: slice | NDArray[np.int64]) -> NDArray[np.floating]:
        """A field of some rows."""
        return self.rows[name][rows]


def boxes_seen(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    scales: NDArray[np.float64],
    camera: Camera,
    near: float,
    low_pass: float = LOW_PASS,
) -> NDArray[np.bool_]:
    """bool[P]: whether a camera may see gaussians of boxes; where not, `cull` draws none of them.

    A footprint reaches into the image from the left if f x/z + c + e > 0, where its half width
    e is at most pad + reach/z with constants for each box. Times z this is linear in the
    centre, so it holds for no centre in a box if it holds for no corner.

    Parameters
    ----------
    low, high : float64[P, 3], corners of the bounding box of the centres, world units.
    scales : float64[P], the largest standard deviation of a gaussian, world units.
    camera : in the same world.
    near : depth of the near plane, world units.
    low_pass : as for `pipeline.Renderer`.
    """
    pick = np.array(list(np.ndindex(2, 2, 2)))
    corners = np.stack([low, high], axis=1)[:, pick, np.arange(3)]
    points = corners @ camera.rotation.T + camera.translation
    slack = ROUNDING * (abs(corners).max(axis=(1, 2)) + abs(camera.translation).max())
    slack = slack[:, None]
    depth = points[..., 2] + slack
    outside: NDArray[np.bool_] = (depth <= near).all(axis=1)
    if camera.orthographic:
        depth = np.ones_like(depth)
    pad = np.sqrt(CUTOFF * low_pass)
    ratios = np.abs(clamped_ratios(camera)).max(axis=0) * (not camera.orthographic)
    for axis, size in enumerate((camera.width, camera.height)):
        focal, centre, ratio = camera.focal[axis], camera.centre[axis], ratios[axis]
        reach = focal * np.sqrt(CUTOFF * (1 + ratio**2)) * scales[:, None]
        reach = reach + slack * (focal + 2 * size + abs(centre))
        across = focal * points[..., axis]
        for side in (across + (centre + pad) * depth, (size - centre + pad) * depth - across):
            outside |= (side + reach <= 0).all(axis=1)
    return ~outside


@dataclass(eq=False)
class SlabFrame:
    """A rendered image that has no adjoint."""

    blended: Blended  # the image, its depth and its transmittance
    slabs: int  # how many slabs were rendered

    @property
    def image(self) -> Array:
        """real[3, H, W]."""
        return self.blended.image


class SlabRenderer:
    """Renders `Parts` in slabs.

    Parameters
    ----------
    device, sh_degree, near, antialiased, background, orthographic, low_pass : as for
        `pipeline.Renderer`.
    limit : gaussians of a slab; None: as many as the device has memory for.
    """

    def __init__(
        self,
        device: Device,
        sh_degree: int,
        near: float,
        antialiased: bool = False,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        limit: int | None = None,
        orthographic: bool = False,
        low_pass: float = LOW_PASS,
    ) -> None:
        self.device, self.near = device, near
        self.limit = limit or gaussian_limit(device, sh_degree)
        self.background = np.asarray(background, np.float64)
        self._renderer = Renderer(
            device, sh_degree, near, antialiased, orthographic=orthographic, low_pass=low_pass
        )  # on black
        self._defines = project_defines(0, antialiased, orthographic)  # for depths alone

    def pack(self, camera: Camera) -> tuple[Camera, Array]:
        """The camera for `render`: in host memory, to choose the parts, and on the device."""
        return camera, self._renderer.pack(camera)

    def render(
        self,
        parts: SlabParts,
        camera: tuple[Camera, Array],
        width: int,
        height: int,
        sh_degree: int,
        with_depth: bool = False,
        depth_percent: int = 0,
    ) -> SlabFrame:
        """Render a model; arguments as for `pipeline.Renderer.render`. A depth at a share of the
        light is, in the slab where the transmittance falls that low, that of this slab's own."""
        host_camera, packed = camera
        real, device = self.device.real, self.device
        image, depth = np.zeros((3, height, width), real), np.zeros((height, width), real)
        left, slabs = np.ones((height, width), real), 0
        drawn = self._front_to_back(parts, host_camera, packed)
        rows: dict[str, Array] = {}
        for begin in range(0, len(drawn), self.limit):
            if left.max() < TRANSMITTANCE_MIN:
                break
            chosen = (drawn[begin : begin + self.limit] & ROW).astype(np.int64)
            rows.clear()  # gives its memory to the next slab
            rows |= {f.name: device.upload(parts.read(f.name, chosen)) for f in LEARNED}
            slab = self._renderer.render(
                rows, packed, width, height, sh_degree, with_depth, depth_percent=depth_percent
            ).blended
            image += left * slab.image.download()
            transmittance = slab.transmittance.download()
            if with_depth and depth_percent:
                found = (left > depth_percent / 100) & (transmittance < 1)
                depth = np.where(found, slab.depth.download(), depth)
            elif with_depth:
                depth += left * slab.depth.download()
            left *= transmittance
            slabs += 1
        image += left * self.background[:, None, None].astype(real)
        return SlabFrame(Blended(device.upload(image), device.upload(left), None, device.upload(depth)), slabs)

    def _front_to_back(self, parts: SlabParts, camera: Camera, packed: Array) -> NDArray[np.uint64]:
        """uint64[V]: the rows that are drawn, by depth as the device computes it, ties by row.

        The lower half of a number is the row, the upper half the key of its depth.
        """
        device, drawn = self.device, [np.empty(0, np.uint64)]
        for piece in parts.seen(camera, self.near, self._renderer.low_pass):
            rows = {name: device.upload(parts.read(name, piece)) for name in CULL_FIELDS}
            counts = new_counts(device)
            visible = self._renderer.visible(rows, packed, counts)
            # the splats are not used, so any colours will do
            rows |= {"sh_constant": rows["positions"], "sh_rest": device.empty((len(rows["positions"]), 0, 3))}
            _, depth_keys = project(device, rows, visible, counts, packed, 0, self._defines)
            drawn.append(
                depth_keys.download().astype(np.uint64) << np.uint64(32) | visible.download() + np.uint64(piece.start)
            )
        order = np.concatenate(drawn)
        order.sort()
        return order
