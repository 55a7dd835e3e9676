"""A response of an image [3, H, W]: a gain by lens (a, b, c, s) and a colour transform E = [M | t],
float64[3, 4]; and what learns it."""

import numpy as np

from tests.reference.adam import adam

NO_LENS = np.zeros(4)


def radius(camera, lens):
    """[H, W]: s times the squared distance of pixels from the optical axis, in focal lengths."""
    x = (np.arange(camera.width) + 0.5 - camera.centre[0]) / camera.focal[0]
    y = (np.arange(camera.height) + 0.5 - camera.centre[1]) / camera.focal[1]
    return lens[3] * (x[None, :] ** 2 + y[:, None] ** 2)


def powers(u):
    return np.stack([u, u**2, u**3])


def gain(lens, u):
    """1 + a u + b u^2 + c u^3."""
    return 1 + np.tensordot(lens[:3], powers(u), 1)


def apply(transform, image, lens=NO_LENS, u=0.0):
    """M (g c) + t at every pixel."""
    u = np.broadcast_to(u, image.shape[1:])
    mixed = np.tensordot(transform[:, :3], gain(lens, u) * image, 1)
    return mixed + transform[:, 3, None, None]


def apply_adjoint(transform, image, grad, lens=NO_LENS, u=0.0):
    """Gradients by the image, the transform and (a, b, c), from that by the result."""
    u = np.broadcast_to(u, image.shape[1:])
    g = gain(lens, u)
    with_one = np.concatenate([g * image, np.ones((1, *image.shape[1:]))])
    by_gained = np.tensordot(transform[:, :3].T, grad, 1)
    return (
        g * by_gained,
        np.tensordot(grad, with_one, axes=((1, 2), (1, 2))),
        np.tensordot(powers(u), (by_gained * image).sum(axis=0), axes=((1, 2), (0, 1))),
    )


def penalty(transform, pull):
    """pull x the mean squared entry of E - I, and its gradient."""
    away = transform - np.eye(3, 4)
    return pull * np.mean(away**2), 2 * pull * away / away.size


def step(transforms, first, second, counts, view, grad, rate, pull):
    """New (transforms [V, 3, 4], moments, counts [V]) after a step on one view.

    grad: [3, 4], of the image's loss; where it is not finite,
    nothing changes.
    """
    return _step(transforms, first, second, counts, view, grad + penalty(transforms[view], pull)[1], rate)


def lens_penalty(lens, pull):
    """pull x the mean squared term of (a, b, c), and its gradient."""
    return pull * np.mean(lens[:3] ** 2), 2 * pull * lens[:3] / 3


def lens_step(lenses, first, second, counts, lens, grad, rate, pull):
    """The same for lenses [L, 4], whose scale stays; moments [L, 3], grad [3]."""
    terms, *rest = _step(lenses[:, :3], first, second, counts, lens, grad + lens_penalty(lenses[lens], pull)[1], rate)
    return np.column_stack([terms, lenses[:, 3]]), *rest


def _step(values, first, second, counts, row, grad, rate):
    if not np.isfinite(grad).all():
        return values, first, second, counts
    counts = counts.copy()
    counts[row] += 1
    spread = np.zeros_like(values)
    spread[row] = grad
    return *adam(values, spread, first, second, int(counts[row]), rate, rows=[row]), counts


def between(to, back):
    """The map [3, 4] that undoes `back` and then does `to`."""

    def square(transform):
        return np.vstack([transform, [0, 0, 0, 1]])

    return (square(to) @ np.linalg.inv(square(back)))[:3]
