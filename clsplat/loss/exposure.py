"""A learned colour transform for each training view, so that photos of drifting exposure agree
(cl/exposure.cl)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import EXPOSURE_BLOCK, FRAME_COUNTS, TRANSFORM_REALS
from clsplat.device import Array, ArraySpec, Device, Forms, Kernel, each, groups
from clsplat.rendering.frame_arrays import FrameArray

IDENTITY = np.eye(3, 4)
LEARNED = ("transforms", "m", "v", "steps")
MAX_CONDITION = 1e3  # of a matrix that may be inverted

_VIEW = dict(pixels="uint", view="uint")
_ROWS, _IMAGE = ("real", "V", TRANSFORM_REALS), ("real", 3, "H", "W")
APPLY = Kernel("exposure.cl", "exposure_apply", each("pixels"), **_VIEW, transforms=_ROWS,
               image=_IMAGE, result=_IMAGE)
ADJOINT = Kernel(
    "exposure.cl", "exposure_adjoint",
    Forms(item=each("blocks"), group=groups("blocks", "SCAN_GROUP")), **_VIEW, blocks="uint",
    transforms=_ROWS, image=_IMAGE, grad=_IMAGE, grad_image=_IMAGE,
    partials=("real", "P", TRANSFORM_REALS))
STEP = Kernel("exposure.cl", "exposure_step", groups("1", "16"), view="uint", rate="real",
              pull="real", counts=("uint", FRAME_COUNTS), partials=("real", "P", TRANSFORM_REALS),
              blocks="uint", transforms=_ROWS, m=_ROWS, v=_ROWS, steps=("uint", "V"),
              skipped=("uint", 1))


class Exposures:
    """Colour transforms c' = M c + t of V views, in display values, and their Adam.

    Parameters
    ----------
    device : the device of the images.
    views : how many views.
    rate : learning rate.
    pull : weight in the loss of mean((E - I)^2) over the 12 entries E of a view's transform.
    initial : float64[V, 3, 4], the transforms [M | t] at the start; None: identities.
    learns : whether the transforms change at all.

    Attributes
    ----------
    transforms, m, v : real[V, 12], the transforms in row-major order, and their Adam moments.
    steps : uint[V], steps of each view.
    skipped : uint[1], steps that were left out because their gradient was not finite.
    """

    transforms: Array
    m: Array
    v: Array
    steps: Array
    skipped: Array

    def __init__(self, device: Device, views: int, rate: float = 1e-3, pull: float = 0.01,
                 initial: NDArray[np.float64] | None = None, learns: bool = True) -> None:
        self.device, self.rate, self.pull, self.learns = device, rate, pull, learns
        self._recentred = np.tile(IDENTITY, (views, 1, 1)) if initial is None else initial
        self._mean = self._recentred.reshape(views, TRANSFORM_REALS).mean(axis=0)
        for name, spec in self.arrays(views).items():
            setattr(self, name, device.zeros(*spec))
        self.transforms.write(self._recentred.reshape(views, TRANSFORM_REALS))

    @staticmethod
    def arrays(views: int) -> dict[str, ArraySpec]:
        """The arrays of a number of views, by attribute."""
        rows, steps = ArraySpec((views, TRANSFORM_REALS)), ArraySpec((views,), np.uint32)
        return {"transforms": rows, "m": rows, "v": rows, "steps": steps,
                "skipped": ArraySpec((1,), np.uint32)}

    @staticmethod
    def frame_arrays(width: int, height: int) -> list[FrameArray]:
        """What `apply` and `adjoint` allocate for an image."""
        image, blocks = (3, height, width), -(-width * height // EXPOSURE_BLOCK)
        return [FrameArray("exposed", image, None, "loss", "project adjoint"),
                FrameArray("grad_rendered", image, None, "exposure", "project adjoint"),
                FrameArray("partials", (blocks, TRANSFORM_REALS), None, "exposure",
                           "project adjoint")]

    def apply(self, view: int, image: Array) -> Array:
        """The image real[3, H, W] with the colour transform of a view, real[3, H, W]."""
        pixels, result = _pixels(image), self.device.empty(image.shape)
        self.device.launch(APPLY, pixels=pixels, view=view, transforms=self.transforms, image=image,
                           result=result)
        return result

    def adjoint(self, view: int, image: Array, grad: Array) -> tuple[Array, Array]:
        """Gradients from `grad` real[3, H, W], the gradient by `apply(view, image)`.

        Returns
        -------
        real[3, H, W], by the image; real[P, 12], partial sums of that by the view's transform.
        """
        device, pixels = self.device, _pixels(image)
        blocks = -(-pixels // EXPOSURE_BLOCK)
        grad_image, partials = device.empty(image.shape), device.empty((blocks, TRANSFORM_REALS))
        device.launch(ADJOINT, pixels=pixels, view=view, blocks=blocks, transforms=self.transforms,
                      image=image, grad=grad, grad_image=grad_image, partials=partials)
        return grad_image, partials

    def step(self, view: int, partials: Array, counts: Array) -> None:
        """Take one step of Adam on a view's transform; does not wait for the device.

        A gradient that is not finite changes nothing, and is counted in `skipped`.

        Parameters
        ----------
        view : index of the view.
        partials : real[P, 12], of `adjoint`.
        counts : uint[FRAME_COUNTS], of the frame; one that has failed changes nothing.
        """
        if self.learns:
            self.device.launch(
                STEP, view=view, rate=self.rate, pull=self.pull, counts=counts, partials=partials,
                blocks=len(partials), transforms=self.transforms, m=self.m, v=self.v,
                steps=self.steps, skipped=self.skipped)

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
        """Colour transforms from one view to another, by the last recentred transforms.

        Parameters
        ----------
        pairs : P pairs (i, j) of views.

        Returns
        -------
        real[P, 12], E_i after the inverse of E_j, which takes colours of view j's photo to those of
        view i's; the identity where E_j is badly conditioned.
        """
        maps = np.tile(IDENTITY, (len(pairs), 1, 1))
        for row, (i, j) in enumerate(pairs):
            to, source = self._recentred[i], self._recentred[j]
            if np.linalg.cond(source[:, :3]) < MAX_CONDITION:
                matrix = to[:, :3] @ np.linalg.inv(source[:, :3])
                maps[row] = np.column_stack([matrix, to[:, 3] - matrix @ source[:, 3]])
        return self.device.upload(maps.reshape(-1, TRANSFORM_REALS))

    def download(self) -> dict[str, NDArray[Any]]:
        """All that was learned, host arrays by name, for `upload`."""
        return {"recentred": self._recentred,
                **{name: getattr(self, name).download() for name in LEARNED}}

    def upload(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Continue from what `download` returned."""
        self._recentred = arrays["recentred"]
        for name in LEARNED:
            getattr(self, name).write(arrays[name])


def _pixels(image: Array) -> int:
    return image.shape[1] * image.shape[2]
