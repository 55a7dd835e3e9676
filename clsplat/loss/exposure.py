"""A learned colour transform a training view, so that drifting photos agree (cl/exposure.cl)."""

import numpy as np

from clsplat.constants import EXPOSURE_BLOCK, TRANSFORM_REALS
from clsplat.device import ArraySpec, Forms, Kernel, each, groups, items
from clsplat.primitives.reduce import sum_columns
from clsplat.rendering.frame_arrays import FrameArray

IDENTITY = np.eye(3, 4)
LEARNED = ("transforms", "m", "v", "counts")
WORST_CONDITION = 1e3  # of a transform that can still be undone

_VIEW = dict(pixels="uint", view="uint")
_ROWS, _IMAGE = ("real", "V", TRANSFORM_REALS), ("real", 3, "H", "W")
APPLY = Kernel("exposure.cl", "exposure_apply", each("pixels"), **_VIEW, transforms=_ROWS,
               image=_IMAGE, result=_IMAGE)
ADJOINT = Kernel(
    "exposure.cl", "exposure_adjoint",
    Forms(item=each("blocks"), group=groups("blocks", "SCAN_GROUP")), **_VIEW, blocks="uint",
    transforms=_ROWS, image=_IMAGE, grad=_IMAGE, grad_image=_IMAGE,
    partials=("real", "P", TRANSFORM_REALS))
STEP = Kernel("exposure.cl", "exposure_step", items("1"), view="uint", rate="real", pull="real",
              totals=("real", TRANSFORM_REALS), transforms=_ROWS, m=_ROWS, v=_ROWS,
              counts=("uint", "V"), skipped=("uint", 1))


class Exposures:
    """Colour transforms c' = M c + t of so many `views`, in display values, and their Adam.

    transforms, m, v: real[V, 12], rows [M | t] of 3 x 4 in row-major order, which start at
    `initial` float64[V, 3, 4], by default identities; counts: uint[V], steps taken by each view;
    skipped: uint[1], steps not taken. rate: learning rate; pull: weight in the loss of
    mean((E - I)^2) over the 12 entries E of the view's row; learns: whether they change at all.
    """

    def __init__(self, device, views, rate=1e-3, pull=0.01, initial=None, learns=True):
        self.device, self.rate, self.pull, self.learns = device, rate, pull, learns
        self._recentred = np.tile(IDENTITY, (views, 1, 1)) if initial is None else initial
        self._mean = self._recentred.reshape(views, TRANSFORM_REALS).mean(axis=0)
        for name, spec in self.arrays(views).items():
            setattr(self, name, device.zeros(*spec))
        self.transforms.write(self._recentred.reshape(views, TRANSFORM_REALS))

    @staticmethod
    def arrays(views: int) -> dict[str, ArraySpec]:
        """The arrays of so many views."""
        rows, counts = ArraySpec((views, TRANSFORM_REALS)), ArraySpec((views,), np.uint32)
        return {"transforms": rows, "m": rows, "v": rows, "counts": counts,
                "skipped": ArraySpec((1,), np.uint32)}

    @staticmethod
    def frame_arrays(width: int, height: int) -> list[FrameArray]:
        """What `apply` and `adjoint` allocate for an image."""
        image, blocks = (3, height, width), -(-width * height // EXPOSURE_BLOCK)
        return [FrameArray("exposed", image, None, "loss", "project adjoint"),
                FrameArray("grad_rendered", image, None, "exposure", "project adjoint"),
                FrameArray("partials", (blocks, TRANSFORM_REALS), None, "exposure",
                           "project adjoint")]

    def apply(self, view, image):
        """real[3, H, W]: the image real[3, H, W] as view number `view` would have taken it."""
        pixels, result = _pixels(image), self.device.empty(image.shape)
        self.device.launch(APPLY, pixels=pixels, view=view, transforms=self.transforms, image=image,
                           result=result)
        return result

    def adjoint(self, view, image, grad):
        """(real[3, H, W], real[P, 12]): the gradient by `image`, and partial sums of that by the
        view's row, from the gradient by `apply(view, image)`."""
        device, pixels = self.device, _pixels(image)
        blocks = -(-pixels // EXPOSURE_BLOCK)
        grad_image, partials = device.empty(image.shape), device.empty((blocks, TRANSFORM_REALS))
        device.launch(ADJOINT, pixels=pixels, view=view, blocks=blocks, transforms=self.transforms,
                      image=image, grad=grad, grad_image=grad_image, partials=partials)
        return grad_image, partials

    def step(self, view, partials):
        """Take one step of Adam on the view's own row, by the partial sums of `adjoint`.

        A gradient that is not finite leaves the row, its moments and its count as they were, and
        is counted in `skipped`. Nothing waits for the device.
        """
        if self.learns:
            self.device.launch(
                STEP, view=view, rate=self.rate, pull=self.pull,
                totals=sum_columns(self.device, partials), transforms=self.transforms, m=self.m,
                v=self.v, counts=self.counts, skipped=self.skipped)

    def recentre(self):
        """Move all rows alike, so that their mean is again what it was at the start; waits.

        The gaussians can make up for a change common to all views, so nothing else holds it; a
        held-out view, drawn without a transform, would show it, and so would the seam between two
        blocks of a scene.
        """
        if not self.learns:
            return
        transforms = self.transforms.download().astype(np.float64)
        transforms -= transforms.mean(axis=0) - self._mean
        self.transforms.write(transforms)
        self._recentred = transforms.reshape(-1, 3, 4)

    def between(self, pairs):
        """real[P, 12] on the device, of P pairs (i, j): rows of 3 x 4 that take colours of view j's
        photo to those of view i's, as they were when last recentred.

        E_i after the inverse of E_j; the identity where E_j cannot be inverted well.
        """
        maps = np.tile(IDENTITY, (len(pairs), 1, 1))
        for row, (i, j) in enumerate(pairs):
            to, back = self._recentred[i], self._recentred[j]
            if np.linalg.cond(back[:, :3]) < WORST_CONDITION:
                matrix = to[:, :3] @ np.linalg.inv(back[:, :3])
                maps[row] = np.column_stack([matrix, to[:, 3] - matrix @ back[:, 3]])
        return self.device.upload(maps.reshape(-1, TRANSFORM_REALS))

    def download(self):
        """Name -> host array of everything learned: what `upload` takes over."""
        return {"recentred": self._recentred,
                **{name: getattr(self, name).download() for name in LEARNED}}

    def upload(self, arrays):
        """Go on from what `download` gave."""
        self._recentred = arrays["recentred"]
        for name in LEARNED:
            getattr(self, name).write(arrays[name])


def _pixels(image):
    return image.shape[1] * image.shape[2]
