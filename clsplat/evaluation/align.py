"""Aligns the poses of held-out views with their photos on a finished model, which does not change.

The given pose of a held-out view is as wrong as those of training views, and its score suffers from
that, the more the sharper the model is. So each view is also compared from the pose from which the
model looks most like its photo: one rule for every run, whatever its schedule and whether or not it
corrected the poses of training views. Such scores compare models. They are not how well a model
predicts a photo, since a little of the photo was used.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import TRANSFORM_REALS
from clsplat.device import Array
from clsplat.errors import InputError
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.loss.exposure import Exposures
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.loss.options import ImageLossOptions
from clsplat.optimise.pose import Poses
from clsplat.placement.corrections import Correction
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.slabs import ModelRenderer
from clsplat.scene import View

STEPS = 60  # of each view
COLOUR_EVERY = 10  # steps between two fits of the colours
FIRST_RATE, LAST_RATE = 0.25, 0.0025  # pixels a step in the middle of the photo
MOST_FITTED = 1 << 16  # pixels of which the colours are fitted


def aligned(renderer: ModelRenderer, rows: Any, degree: int, view: View, depth: float) -> Correction:
    """The correction of a view's pose with which a model looks most like its photo.

    STEPS steps of Adam on the pose against the loss of training; the colours of the render follow
    the photo by an affine map that is fitted in between. A correction after which the loss is not
    lower than before is not made.

    Parameters
    ----------
    renderer, rows, degree : a model on the device.
    view : the photo, and the camera as it was given.
    depth : world units, a typical depth of what is seen (`placement.corrections.typical_depth`).

    Raises
    ------
    InputError : the model is larger than the device's memory.
    """
    if not isinstance(renderer, Renderer):
        raise InputError(
            "poses cannot be aligned: the model is larger than the memory of the device; leave --align out"
        )
    device, camera, weight = renderer.device, view.camera, ImageLossOptions.ssim_weight
    size = camera.width, camera.height
    pixels, valid = read_photo(view), read_valid(view)
    planes = [*pixels.transpose(2, 0, 1), *([] if valid is None else [255 * valid])]
    photo = device.upload(np.array(planes, np.uint8), np.uint8)
    poses, colours = Poses(device, [camera], depth, pull=0.0), Exposures(device, 1)
    packed, losses = renderer.pack(camera), list[float]()
    for step in range(STEPS + 1):
        corrected = poses.apply(0, packed)
        frame = renderer.render(rows, corrected, *size, degree, exposure=colours.of(0, corrected))
        if step % COLOUR_EVERY == 0:
            colours.transforms.write(_affine(frame.image, pixels, valid))
            frame = renderer.render(rows, corrected, *size, degree, exposure=colours.of(0, corrected))
        partials, grad = image_loss(device, frame.exposed, photo, weight)
        if step % STEPS == 0:
            losses.append(loss_value(partials, 3 * size[0] * size[1], weight)[0])
        if step < STEPS:
            grad, _ = colours.adjoint(0, corrected, frame.image, grad)
            gradients = renderer.adjoint(rows, frame, grad, with_pose=True)
            assert gradients.pose_terms is not None
            rate = FIRST_RATE * (LAST_RATE / FIRST_RATE) ** (step / (STEPS - 1)) / camera.focal[0]
            poses.step(0, rate, packed, gradients.pose_terms, frame.counts)
    if not losses[-1] < losses[0]:
        return Correction(np.zeros(3), np.zeros(3))
    return poses.corrections()[0]


def _affine(image: Array, photo: NDArray[np.uint8], valid: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """float64[1, 12], the affine map of colours that brings an image closest to its photo."""
    colours = image.download().reshape(3, -1).T.astype(np.float64)
    kept = np.arange(len(colours)) if valid is None else np.flatnonzero(valid)
    kept = kept[:: -(-len(kept) // MOST_FITTED)]
    known = np.column_stack([colours[kept], np.ones(len(kept))])
    weights = np.linalg.lstsq(known, photo.reshape(-1, 3)[kept] / 255.0, rcond=None)[0]
    return np.reshape(weights.T, (1, TRANSFORM_REALS))
