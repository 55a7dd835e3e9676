"""A colour transform E = [M | t], float64[3, 4], of an image [3, H, W], and what learns it."""

import numpy as np

from tests.reference.adam import adam


def apply(transform, image):
    """M c + t at every pixel."""
    return np.tensordot(transform[:, :3], image, 1) + transform[:, 3, None, None]


def apply_adjoint(transform, image, grad):
    """Gradients by the image and by the transform, from that by the result."""
    with_one = np.concatenate([image, np.ones((1, *image.shape[1:]))])
    return (np.tensordot(transform[:, :3].T, grad, 1),
            np.tensordot(grad, with_one, axes=((1, 2), (1, 2))))


def penalty(transform, pull):
    """pull x the mean squared entry of E - I, and its gradient."""
    away = transform - np.eye(3, 4)
    return pull * np.mean(away**2), 2 * pull * away / away.size


def step(transforms, first, second, counts, view, grad, rate, pull):
    """New (transforms [V, 3, 4], moments, counts [V]) after a step on one view.

    grad: [3, 4], of the image's loss; where it is not finite,
    nothing changes.
    """
    grad = grad + penalty(transforms[view], pull)[1]
    if not np.isfinite(grad).all():
        return transforms, first, second, counts
    counts = counts.copy()
    counts[view] += 1
    spread = np.zeros_like(transforms)
    spread[view] = grad
    return *adam(transforms, spread, first, second, int(counts[view]), rate, rows=[view]), counts


def between(to, back):
    """The map [3, 4] that undoes `back` and then does `to`."""
    def square(transform):
        return np.vstack([transform, [0, 0, 0, 1]])
    return (square(to) @ np.linalg.inv(square(back)))[:3]
