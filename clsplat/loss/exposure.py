"""A learned response for each training view, so that photos of drifting exposure and the middle and
the corners of photos agree (cl/exposure.cl)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat import constants
from clsplat.device import Array, Device, Forms, Kernel, each, groups
from clsplat.rendering.blend import RESPONSE, Exposure, response_defines
from clsplat.response import Lenses, Response

IDENTITY = np.eye(3, 4)
LEARNED = ("transforms", "m", "v", "steps")
LEARNED_VIGNETTING = ("lenses", "lens_m", "lens_v", "lens_steps")
MAX_CONDITION = 1e3  # of a matrix that may be inverted

_ROWS, _IMAGE = ("real", "V", constants.TRANSFORM_REALS), ("real", 3, "H", "W")
_LENS_ROWS = "real", "L", constants.VIGNETTING_TERMS
_LENSES = dict(lens_of=("uint", "V"), lenses=("real", "L", constants.VIGNETTING_REALS))
ADJOINT = Kernel(
    "exposure.cl",
    "exposure_adjoint",
    Forms(item=each("blocks"), group=groups("blocks", "SCAN_GROUP")),
    pixels="uint",
    width="uint",
    blocks="uint",
    **RESPONSE,
    image=_IMAGE,
    grad=_IMAGE,
    grad_image=_IMAGE,
    partials=("real", "P", "S"),
)
STEP = Kernel(
    "exposure.cl",
    "exposure_step",
    groups("1", "16"),
    view="uint",
    rate="real",
    pull="real",
    counts=("uint", constants.FRAME_COUNTS),
    partials=("real", "P", "S"),
    blocks="uint",
    transforms=_ROWS,
    m=_ROWS,
    v=_ROWS,
    steps=("uint", "V"),
    **_LENSES,
    lens_m=_LENS_ROWS,
    lens_v=_LENS_ROWS,
    lens_steps=("uint", "L"),
    skipped=("uint", 1),
)


class Exposures:
    """Responses of V views (clsplat/response.py), and their Adam.

    Parameters
    ----------
    views : how many views.
    rate : learning rate.
    pull : weight in the loss of mean((E - I)^2) over the 12 entries E of a view's transform, and of
        the mean square of the three numbers of its lens's vignetting.
    initial : float64[V, 3, 4], the transforms [M | t] at the start; None: identities.
    learns : whether the responses change at all.
    lenses : the lenses of the views, whose vignetting is learned; None: it is not.

    Attributes
    ----------
    transforms, m, v : real[V, 12], the transforms in row-major order, and their Adam moments.
    steps : uint[V], steps of each view.
    lens_of, lenses : uint[V] and real[L, 4], as `Lenses` has them.
    lens_m, lens_v : real[L, 3], the Adam moments of the vignetting.
    lens_steps : uint[L], steps of each lens.
    skipped : uint[1], steps that were left out because their gradient was not finite.
    """

    def __init__(
        self,
        device: Device,
        views: int,
        rate: float = 1e-3,
        pull: float = 0.01,
        initial: NDArray[np.float64] | None = None,
        learns: bool = True,
        lenses: Lenses | None = None,
    ) -> None:
        self.device, self.rate, self.pull, self.learns = device, rate, pull, learns
        self._recentred = np.tile(IDENTITY, (views, 1, 1)) if initial is None else initial
        self._mean = self._recentred.reshape(views, constants.TRANSFORM_REALS).mean(axis=0)
        self.has_vignetting = lenses is not None
        self._defines = response_defines(self.has_vignetting)
        self._learned = LEARNED + LEARNED_VIGNETTING * self.has_vignetting
        self.transforms, self.m, self.v = (device.zeros((views, constants.TRANSFORM_REALS)) for _ in range(3))
        # without lenses a token stands for them
        count = len(lenses.rows) if lenses else 1
        self.lenses = device.zeros((count, constants.VIGNETTING_REALS))
        self.lens_m, self.lens_v = (device.zeros((count, constants.VIGNETTING_TERMS)) for _ in range(2))
        self.steps, self.lens_of, self.lens_steps, self.skipped = (
            device.zeros(number, np.uint32) for number in (views, views, count, 1)
        )
        if lenses:
            self.lens_of.write(lenses.of)
            self.lenses.write(lenses.rows)
        self.transforms.write(self._recentred.reshape(views, constants.TRANSFORM_REALS))

    def of(self, view: int, camera: Array) -> Exposure:
        """The response of a view, for `Renderer.render`; `camera` is its packed camera."""
        lens = (camera, self.lens_of, self.lenses) if self.has_vignetting else ()
        return Exposure(self.transforms, view, *lens)

    def adjoint(self, view: int, camera: Array, image: Array, grad: Array) -> tuple[Array, Array]:
        """Gradients from those (`grad`) by the photo that the response makes of an image real[3, H,
        W].

        Returns real[3, H, W], by the image; real[P, 12 or 15], partial sums of those by the view's
        transform and by the vignetting of its lens.
        """
        device, (_, height, width) = self.device, image.shape
        blocks = -(-width * height // constants.EXPOSURE_BLOCK)
        sums = constants.TRANSFORM_REALS + constants.VIGNETTING_TERMS * self.has_vignetting
        partials = device.empty((blocks, sums))
        grad_image = device.empty(image.shape)
        device.launch(
            ADJOINT,
            self._defines,
            pixels=width * height,
            width=width,
            blocks=blocks,
            view=view,
            transforms=self.transforms,
            camera=camera,
            lens_of=self.lens_of,
            lenses=self.lenses,
            image=image,
            grad=grad,
            grad_image=grad_image,
            partials=partials,
        )
        return grad_image, partials

    def step(self, view: int, partials: Array, counts: Array) -> None:
        """Take one step of Adam on a view's transform and its lens; does not wait for the device.

        `partials` are those of `adjoint`. A gradient that is not finite changes nothing, and is
        counted in `skipped`; a frame that has failed (`counts`) changes nothing.
        """
        if self.learns:
            self.device.launch(
                STEP,
                self._defines,
                view=view,
                rate=self.rate,
                pull=self.pull,
                counts=counts,
                partials=partials,
                blocks=len(partials),
                transforms=self.transforms,
                m=self.m,
                v=self.v,
                steps=self.steps,
                lens_of=self.lens_of,
                lenses=self.lenses,
                lens_m=self.lens_m,
                lens_v=self.lens_v,
                lens_steps=self.lens_steps,
                skipped=self.skipped,
            )

    def responses(self) -> list[Response]:
        """The responses of the views; waits for the device."""
        transforms = self.transforms.download().astype(np.float64).reshape(-1, 3, 4)
        if not self.has_vignetting:
            return [Response(transform) for transform in transforms]
        lenses = self.lenses.download().astype(np.float64)
        return [Response(transform, lenses[lens]) for transform, lens in zip(transforms, self.lens_of.download())]

    def recentre(self) -> None:
        """Shift all transforms equally, so that their mean is again that at the start; waits.

        The gaussians can compensate a change that is common to all views, so nothing else prevents
        it. But it would show in held-out views, which are rendered without a transform, and at the
        seam between two blocks of a scene.
        """
        if not self.learns:
            return
        transforms = self.transforms.download().astype(np.float64)
        transforms -= transforms.mean(axis=0) - self._mean
        self.transforms.write(transforms)
        self._recentred = transforms.reshape(-1, 3, 4)

    def between(self, pairs: Sequence[tuple[int, int]]) -> Array:
        """Colour transforms from one view to another, by the last recentred transforms alone.

        Returns real[P, 12] for pairs (i, j): E_i after the inverse of E_j, which takes colours of
        view j's photo to those of view i's; the identity where E_j is badly conditioned.
        """
        maps = np.tile(IDENTITY, (len(pairs), 1, 1))
        for row, (i, j) in enumerate(pairs):
            to, source = self._recentred[i], self._recentred[j]
            if np.linalg.cond(source[:, :3]) < MAX_CONDITION:
                matrix = to[:, :3] @ np.linalg.inv(source[:, :3])
                maps[row] = np.column_stack([matrix, to[:, 3] - matrix @ source[:, 3]])
        return self.device.upload(maps.reshape(-1, constants.TRANSFORM_REALS))

    def download(self) -> dict[str, NDArray[Any]]:
        """All that was learned, host arrays by name, for `upload`."""
        return {"recentred": self._recentred, **{name: getattr(self, name).download() for name in self._learned}}

    def upload(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Continue from what `download` returned."""
        self._recentred = arrays["recentred"]
        for name in self._learned:
            getattr(self, name).write(arrays[name])
