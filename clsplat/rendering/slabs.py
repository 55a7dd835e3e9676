"""Frames of models larger than the device: slabs of depth, one after the other, front to back.

Rows stay in host memory. Boxes around parts of them say which parts a view cannot see; of the
others `cull` finds, on the device, the gaussians that are drawn and their depth keys. Sorted by
key, ties by row, they are cut into slabs that fit. Each is rendered by itself, and laid behind
those before it:

    C = C1 + T1 C2,  D = D1 + T1 D2,  T = T1 T2

The order is that of a frame in one piece, to the last tie. Only the stop differs: blending ends a
pixel before its transmittance would fall below TRANSMITTANCE_MIN, and a slab begins with 1 again.
What a slab then adds, a frame in one piece leaves out; it weighs less than TRANSMITTANCE_MIN / (1 -
ALPHA_MAX) = 0.01 where all but opaque gaussians lie behind each other, and mostly far less.
"""

from dataclasses import dataclass

import numpy as np

from clsplat.constants import ALPHA_STEPS, SPLAT_REALS, TRANSMITTANCE_MIN
from clsplat.gaussians import LEARNED
from clsplat.rendering.bands import LARGEST_SHARE
from clsplat.rendering.blend import Blended
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import LOW_PASS, clamped_ratios, cull

MODEL_SHARE = 0.3  # of the device's memory for a model and its splats; two may be compared
INDICES = 6  # uint a gaussian that culling and sorting take
PART = 1 << 16  # rows that share a box
CUTOFF = 2.01 * np.log(ALPHA_STEPS)  # squared distance: at least largest_extent's of cl/project.cl
ROUNDING = 1e-5  # of coordinates, that float32 may lose on the way to a pixel
CULLED = ("positions", "log_scales", "quaternions", "opacity_logits")


def gaussian_limit(device, sh_degree):
    """Gaussians of a model that may be on the device at a time: those for which it has room."""
    widths = [field.width(sh_degree) for field in LEARNED]
    real = device.real.itemsize
    room = MODEL_SHARE * device.handle.global_mem_size / (
        real * (sum(widths) + SPLAT_REALS) + 4 * INDICES)
    in_a_buffer = LARGEST_SHARE * device.largest_buffer / (real * max(*widths, SPLAT_REALS))
    return max(1, int(min(room, in_a_buffer)))


def open_model(device, gaussians, near, antialiased=False, background=(0.0, 0.0, 0.0)):
    """(renderer, rows) of finished Gaussians: a Renderer and device rows where these fit, else a
    SlabRenderer and `Parts`; both render alike. The rest as in `pipeline.Renderer`."""
    settings = device, gaussians.sh_degree, near, antialiased, background
    limit = gaussian_limit(device, gaussians.sh_degree)
    if gaussians.count > limit:
        return SlabRenderer(*settings, limit), Parts.of(gaussians.rows)
    rows = {field.name: device.upload(gaussians.rows[field.name]) for field in LEARNED}
    return Renderer(*settings), rows


@dataclass(frozen=True, eq=False)
class Parts:
    """rows: field -> float[N, *row shape] in host memory; firsts: int[P + 1], where parts of them
    begin; low, high: float64[P, 3], the boxes of their centres; scales: float64[P], the largest
    standard deviation in each. World units."""

    rows: dict
    firsts: np.ndarray
    low: np.ndarray
    high: np.ndarray
    scales: np.ndarray

    @classmethod
    def of(cls, rows, size=PART):
        """Parts of `size` neighbouring rows: those of a block of a merged model lie together."""
        positions, log_scales = rows["positions"], rows["log_scales"]
        firsts = np.append(np.arange(0, len(positions), size), len(positions))
        pieces = [slice(*ends) for ends in zip(firsts, firsts[1:])]
        low, high = (np.array([end(positions[piece], axis=0) for piece in pieces],
                              np.float64).reshape(-1, 3) for end in (np.min, np.max))
        largest = np.array([log_scales[piece].max() for piece in pieces], np.float64)
        return cls(rows, firsts, low, high, np.exp(largest))

    def seen(self, camera, near):
        """Slices of the rows that a Camera may see: what `cull` would draw is in one of them.

        A footprint reaches into the image from the left if f x/z + c + e > 0, its half width e at
        most pad + reach/z with constants a part: times z this is linear in the centre, hence true
        of none in a box if it is of no corner.
        """
        pick = np.array(list(np.ndindex(2, 2, 2)))
        corners = np.stack([self.low, self.high], axis=1)[:, pick, np.arange(3)]
        points = corners @ camera.rotation.T + camera.translation
        slack = ROUNDING * (abs(corners).max(axis=(1, 2)) + abs(camera.translation).max())
        slack = slack[:, None]
        depth = points[..., 2] + slack
        outside = (depth <= near).all(axis=1)
        pad = np.sqrt(CUTOFF * LOW_PASS)
        ratios = np.abs(clamped_ratios(camera)).max(axis=0)
        for axis, size in enumerate((camera.width, camera.height)):
            focal, centre, ratio = camera.focal[axis], camera.centre[axis], ratios[axis]
            reach = focal * np.sqrt(CUTOFF * (1 + ratio**2)) * self.scales[:, None]
            reach = reach + slack * (focal + 2 * size + abs(centre))
            across = focal * points[..., axis]
            for side in (across + (centre + pad) * depth, (size - centre + pad) * depth - across):
                outside |= (side + reach <= 0).all(axis=1)
        return [slice(*self.firsts[part:part + 2]) for part in np.flatnonzero(~outside)]


@dataclass(eq=False)
class SlabFrame:
    """A picture without what its adjoint would need; slabs: how many were drawn."""

    blended: Blended
    slabs: int

    @property
    def image(self):
        return self.blended.image


class SlabRenderer:
    """Renders `Parts` as Renderer does device rows, at most `limit` gaussians at a time.

    limit: None takes what the device has room for; the rest as in `pipeline.Renderer`.
    """

    def __init__(self, device, sh_degree, near, antialiased=False, background=(0.0, 0.0, 0.0),
                 limit=None):
        self.device, self.near = device, near
        self.limit = limit or gaussian_limit(device, sh_degree)
        self.background = np.asarray(background, np.float64)
        self._renderer = Renderer(device, sh_degree, near, antialiased)  # on black
        self._defines = (("SH_REST", (sh_degree + 1) ** 2 - 1), ("ANTIALIASED", int(antialiased)))

    def pack(self, camera):
        """The camera for `render`: in host memory too, which chooses the parts."""
        return camera, self._renderer.pack(camera)

    def render(self, parts, camera, width, height, degree, with_depth=False):
        """Render `Parts` with a camera of `pack`; returns a SlabFrame."""
        seen_by, packed = camera
        real, device = self.device.real, self.device
        image, depth = np.zeros((3, height, width), real), np.zeros((height, width), real)
        left, slabs = np.ones((height, width), real), 0
        drawn = self._front_to_back(parts, seen_by, packed)
        for begin in range(0, len(drawn), self.limit):
            if left.max() < TRANSMITTANCE_MIN:
                break
            chosen = drawn[begin:begin + self.limit]
            rows = {f.name: device.upload(parts.rows[f.name][chosen]) for f in LEARNED}
            slab = self._renderer.render(rows, packed, width, height, degree, with_depth).blended
            image += left * slab.image.download()
            if with_depth:
                depth += left * slab.depth.download()
            left *= slab.transmittance.download()
            slabs += 1
        image += left * self.background[:, None, None].astype(real)
        return SlabFrame(Blended(device.upload(image), device.upload(left), None,
                                 device.upload(depth)), slabs)

    def _front_to_back(self, parts, camera, packed):
        """int64[V]: the rows that are drawn, by depth as the device computes it, ties by row."""
        rows, keys = [np.empty(0, np.int64)], [np.empty(0, np.uint32)]
        for piece in parts.seen(camera, self.near):
            on_device = {name: self.device.upload(parts.rows[name][piece]) for name in CULLED}
            flags, depth_keys = cull(self.device, on_device, packed, self._defines)
            drawn = np.flatnonzero(flags.download())
            rows.append(piece.start + drawn)
            keys.append(depth_keys.download()[drawn])
        return np.concatenate(rows)[np.argsort(np.concatenate(keys), kind="stable")]
