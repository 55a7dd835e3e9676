"""A response of an image [3, H, W]: a gain by lens (a, b, c, s) and a colour transform E = [M | t],
float64[3, 4], between the inverse of a tone curve with bends (a, b) and the curve; and what learns
it."""

import numpy as np

from tests.reference.adam import adam

NO_LENS, NO_TONE = np.zeros(4), np.zeros(2)


def radius(camera, lens):
    """[H, W]: s times the squared distance of pixels from the optical axis, in focal lengths."""
    x = (np.arange(camera.width) + 0.5 - camera.centre[0]) / camera.focal[0]
    y = (np.arange(camera.height) + 0.5 - camera.centre[1]) / camera.focal[1]
    return lens[3] * (x[None, :]**2 + y[:, None]**2)


def powers(u):
    return np.stack([u, u**2, u**3])


def gain(lens, u):
    """1 + a u + b u^2 + c u^3."""
    return 1 + np.tensordot(lens[:3], powers(u), 1)


def in_front(colour, clear, image):
    """An image behind a layer of colour [3, H, W] and transmittance [H, W]."""
    return colour + clear * image


def in_front_adjoint(clear, grad):
    """The gradient by the image."""
    return clear * grad


def bend(t, p):
    """t / (|t| + k (1 - |t|)), k = e^-p, of |t| < 1, with its derivatives by t and p; else linear.

    The derivative by p is that of the quotient: -t (1 - |t|) / (...)^2 dk/dp.
    """
    k, size = np.exp(-p), np.abs(t)
    below = size + k * (1 - size)
    beyond = size > 1
    return (np.where(beyond, np.sign(t) + k * (t - np.sign(t)), t / below),
            np.where(beyond, k, k / below**2),
            np.where(beyond, -k * (t - np.sign(t)), k * t * (1 - size) / below**2))


def curve(x, tone):
    """The curve, and its derivatives by x and by each bend."""
    bent, slope, by_b = bend(2 * x - 1, tone[1])
    y, rate, by_a = bend((1 + bent) / 2, tone[0])
    return y, rate * slope, np.stack([by_a, rate * by_b / 2])


def inverse(y, tone):
    """The same of the inverse; its derivatives follow from those of the curve at its value."""
    middle = bend(y, -tone[0])[0]
    x = (1 + bend(2 * middle - 1, -tone[1])[0]) / 2
    _, slope, by_tone = curve(x, tone)
    return x, 1 / slope, -by_tone / slope


def apply(transform, image, lens=NO_LENS, u=0.0, tone=NO_TONE):
    """f(M (g f^-1(c)) + t) at every pixel."""
    light, u = inverse(image, tone)[0], np.broadcast_to(u, image.shape[1:])
    mixed = np.tensordot(transform[:, :3], gain(lens, u) * light, 1)
    return curve(mixed + transform[:, 3, None, None], tone)[0]


def apply_adjoint(transform, image, grad, lens=NO_LENS, u=0.0, tone=NO_TONE):
    """Gradients by the image, the transform, (a, b, c) and the bends, from that by the result."""
    u = np.broadcast_to(u, image.shape[1:])
    g = gain(lens, u)
    light, slope, by_tone = inverse(image, tone)
    with_one = np.concatenate([g * light, np.ones((1, *image.shape[1:]))])
    _, rate, by_tone_after = curve(np.tensordot(transform, with_one, 1), tone)
    by_mixed = rate * grad
    by_gained = np.tensordot(transform[:, :3].T, by_mixed, 1)
    return (slope * g * by_gained, np.tensordot(by_mixed, with_one, axes=((1, 2), (1, 2))),
            np.tensordot(powers(u), (by_gained * light).sum(axis=0), axes=((1, 2), (0, 1))),
            (by_tone_after * grad + by_tone * g * by_gained).sum(axis=(1, 2, 3)))


def penalty(transform, pull):
    """pull x the mean squared entry of E - I, and its gradient."""
    away = transform - np.eye(3, 4)
    return pull * np.mean(away**2), 2 * pull * away / away.size


def step(transforms, first, second, counts, view, grad, rate, pull):
    """New (transforms [V, 3, 4], moments, counts [V]) after a step on one view.

    grad: [3, 4], of the image's loss; where it is not finite,
    nothing changes.
    """
    return _step(transforms, first, second, counts, view,
                 grad + penalty(transforms[view], pull)[1], rate)


def lens_penalty(lens, pull):
    """pull x the mean squared term of (a, b, c), and its gradient."""
    return pull * np.mean(lens[:3]**2), 2 * pull * lens[:3] / 3


def lens_step(lenses, first, second, counts, lens, grad, rate, pull):
    """The same for lenses [L, 4], whose scale stays; moments [L, 3], grad [3]."""
    terms, *rest = _step(lenses[:, :3], first, second, counts, lens,
                         grad + lens_penalty(lenses[lens], pull)[1], rate)
    return np.column_stack([terms, lenses[:, 3]]), *rest


def tone_step(tones, first, second, counts, lens, grad, rate, pull, most):
    """The same for the bends [L, 2], which stay within `most`."""
    penalty = 2 * pull * tones[lens] / 2
    tones, *rest = _step(tones, first, second, counts, lens, grad + penalty, rate)
    return np.clip(tones, -most, most), *rest


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
