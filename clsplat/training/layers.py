"""The surroundings of a block, drawn once for each of its views as layers behind and in front.

Only what they look like is kept: surroundings have no rows in the model, no moments and no
gradients. They do not change, so a level draws them once, and a resumed run draws the same bytes
again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import EXPOSURE_BLOCK, TRANSFORM_REALS
from clsplat.device import Array, ArraySpec, Device
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.partition.blocks import VISIBLE_DEVIATIONS, shown_sizes
from clsplat.partition.clusters import Clusters
from clsplat.partition.surroundings import Sides
from clsplat.rendering.blend import BACK_PLANES, FRONT_AND_BACK_PLANES
from clsplat.rendering.slabs import Parts, open_model
from clsplat.scene import Scene, View

if TYPE_CHECKING:
    from clsplat.rendering.options import RenderingOptions

LOOKED_AT = 4096  # gaussians at a time, until one is found that a view shows
HIDDEN = -100.0  # opacity logit of gaussians that are not drawn
Planes = NDArray[np.uint8]  # [3 or 7, H, W], see cl/include/respond.h


class Layers:
    """`layers[i]` is what view i shows of the surroundings at the present level.

    It is uchar[3, H, W] where nothing is in front of the block, else uchar[7, H, W]
    (cl/include/respond.h). The layers of a level stay on the device if they fit beside its photos,
    otherwise in a temporary file.

    Parameters
    ----------
    device : of the training.
    scene : the block's scene.
    surroundings : the gaussians around it, in the scene's frame.
    near : depth of the near plane, in units of the scene.
    options : of the training.

    Attributes
    ----------
    resident : whether the layers of this level stay on the device.
    """

    def __init__(self, device: Device, scene: Scene, surroundings: Gaussians, near: float,
                 options: RenderingOptions) -> None:
        self.device, self.resident = device, True
        self._draw: Callable[[Sequence[View]], Iterator[Planes]] = lambda views: drawn_layers(
            device, scene, surroundings, views, near, options)
        self._level = 0.0  # none yet

    def use(self, level: float, views: Sequence[View], spare_bytes: float) -> None:
        """Draw the layers of a level; InputError if the disk has no space for them.

        Parameters
        ----------
        level : down-sampling factor.
        views : the training views at that level.
        spare_bytes : that layers may take on the device.
        """
        if level == self._level:
            return
        self._level = level
        self._arrays: list[Array] = []
        self._file: IO[bytes] | None = None
        self._places: list[tuple[int, tuple[int, ...]]] = []
        most = sum(layer_array(view, True).nbytes(self.device.real) for view in views)
        self.resident = most <= spare_bytes
        for planes in self._draw(views):
            if self.resident:
                self._arrays.append(self.device.upload(planes))
            else:
                self._keep(planes)

    def _keep(self, planes: Planes) -> None:
        """Write planes to the temporary file."""
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()
            self._places.append((self._file.seek(0, 2), planes.shape))
            self._file.write(planes.tobytes())
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"{tempfile.gettempdir()}: cannot keep what surrounds the block ({error.strerror})"
                "; make space there, or let TMPDIR name another folder") from None

    def __getitem__(self, index: int) -> Array:
        if self.resident:
            return self._arrays[index]
        assert self._file is not None
        place, shape = self._places[index]
        self._file.seek(place)
        count = int(np.prod(shape))
        return self.device.upload(
            np.frombuffer(self._file.read(count), np.uint8).reshape(shape))


def layer_array(view: View, has_front: bool) -> ArraySpec:
    """The device array of a view's layers."""
    planes = FRONT_AND_BACK_PLANES if has_front else BACK_PLANES
    return ArraySpec((planes, view.camera.height, view.camera.width), np.uint8)


class Front:
    """Tells whether views may show surroundings in front of the block, even if faintly.

    Parameters
    ----------
    surroundings : of the block.
    near : as for `drawn_layers`.
    """

    def __init__(self, surroundings: Gaussians, near: float) -> None:
        deviations = np.exp(np.maximum.reduce(surroundings.log_scales.T)).astype(np.float64)
        self._clusters = Clusters(surroundings.positions, VISIBLE_DEVIATIONS * deviations)
        self._positions = surroundings.positions[self._clusters.order]
        self._deviations, self._near = deviations[self._clusters.order], near

    def is_shown(self, view: View, behind: NDArray[np.bool_]) -> bool:
        """Whether a view may show some of it.

        Parameters
        ----------
        view : of the block, at its level.
        behind : bool[N], those of the surroundings behind the block (`Sides`).
        """
        rows = self._clusters.near_view(view.camera, self._near)
        rows = rows[~behind[self._clusters.order[rows]]]
        return any(shown_sizes(self._positions[some], self._deviations[some], view.camera,
                               self._near).any()
                   for some in np.split(rows, range(LOOKED_AT, len(rows), LOOKED_AT)))


def compared_bytes(scene: Scene, surroundings: Gaussians, sh_degree: int, exposes: bool
                   ) -> tuple[int, int]:
    """Device bytes of a block's surroundings as layers, and as gaussians that the model holds.

    Both follow from counts alone, so that every machine finds the same.

    Parameters
    ----------
    scene, surroundings : as for `Layers`; its views are those of the block's finest level.
    sh_degree : of the block's model, which would have parameters and moments of them.
    exposes : whether a step exposes its image without layers too.
    """
    real, near = np.dtype(np.float32), scene.near_plane
    layers = step = 0
    sides, front = Sides(scene, surroundings.positions), Front(surroundings, near)
    for view in scene.views:
        in_front = front.is_shown(view, sides.behind(view.camera.position))
        layers += layer_array(view, in_front).nbytes(real)
        pixels = view.camera.width * view.camera.height
        # the exposed image, the gradient by the image, and partial sums of the gradient
        step = max(step, real.itemsize * (
            2 * 3 * pixels + TRANSFORM_REALS * -(-pixels // EXPOSURE_BLOCK)))
    floats = sum(field.width(sh_degree) for field in LEARNED)
    return layers + (0 if exposes else step), 3 * real.itemsize * floats * surroundings.count


def drawn_layers(device: Device, scene: Scene, surroundings: Gaussians, views: Sequence[View],
                 near: float, options: RenderingOptions) -> Iterator[Planes]:
    """Draw what each view shows of the surroundings of a block.

    All of them are on the device meanwhile; those on the other side are transparent.

    Parameters
    ----------
    device, scene, surroundings, near, options : as for `Layers`.
    views : of the block, at its level.

    Yields
    ------
    uint8[3, H, W], or uint8[7, H, W] where something is in front of the block.
    """
    sides, logits = Sides(scene, surroundings.positions), surroundings.rows["opacity_logits"]
    background = np.array(options.background)[:, None, None]
    renderer, rows = open_model(
        device, Gaussians(dict(surroundings.rows), surroundings.sh_degree), near,
        options.antialiased, options.background)

    def drawn(view: View, which: NDArray[np.bool_]
              ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """The image [3, H, W] and the transmittance [1, H, W] of some of the surroundings."""
        shown = np.where(which, logits, HIDDEN).astype(logits.dtype)
        if isinstance(rows, Parts):
            rows.rows["opacity_logits"] = shown
        else:
            rows["opacity_logits"].write(shown)
        blended = renderer.render(rows, renderer.pack(view.camera), view.camera.width,
                                  view.camera.height, surroundings.sh_degree).blended
        image, clear = blended.image.download(), blended.transmittance.download()[None]
        return image, clear

    for view in views:
        behind = sides.behind(view.camera.position)
        back = eight_bits(drawn(view, behind)[0])
        if not behind.all():
            colour, clear = drawn(view, ~behind)
            front = [eight_bits(colour - clear * background), eight_bits(clear)]
            if front[0].any() or front[1].min() < 255:
                back = np.concatenate([back, *front])
        device.trim()  # the frames of the next view have other sizes
        yield back


def eight_bits(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Values from 0 to 1 as bytes; what is not a number becomes 0."""
    values = np.fmax(values, 0)  # which takes the other value where one is not a number
    np.fmin(values, 1, out=values)
    values *= 255
    rounded: NDArray[np.uint8] = np.rint(values, out=values).astype(np.uint8)
    return rounded
