"""FLIP against the formulas of Andersson et al. (2020), in float64 numpy."""

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from clsplat.evaluation.metrics import PIXELS_PER_DEGREE, flip, flip_map

WHITE = np.array([0.950428545, 1.0, 1.088900371])  # D65
TO_XYZ = np.array([[10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
                   [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
                   [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382]])
# weight and width of the contrast sensitivity's gaussians: luminance, red-green, blue-yellow
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))


def linear(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def opponent(rgb):
    x, y, z = np.moveaxis(rgb @ TO_XYZ.T / WHITE, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def hunt_lab(rgb):
    t = rgb @ TO_XYZ.T / WHITE
    x, y, z = np.moveaxis(np.where(t > (6 / 29) ** 3, np.cbrt(t), t * (29 / 6) ** 2 / 3 + 4 / 29),
                          -1, 0)
    light = 116 * y - 16
    return np.stack([light, light / 100 * 500 * (x - y), light / 100 * 200 * (y - z)], axis=-1)


def distance(a, b):
    d = np.abs(a - b)
    return (d[..., 0] + np.hypot(d[..., 1], d[..., 2])) ** 0.7


def filtered(rgb):
    """The linear colours that the eye sees at this distance."""
    radius = int(np.ceil(3 * np.sqrt(0.04 / (2 * np.pi**2)) * PIXELS_PER_DEGREE))
    x, y = np.mgrid[-radius:radius + 1, -radius:radius + 1] / PIXELS_PER_DEGREE
    channels = []
    for channel, terms in zip(np.moveaxis(opponent(rgb), -1, 0), SENSITIVITY):
        sums = 0
        for weight, width in terms:
            # exp(-pi² (x² + y²) / b) is a product of two exponentials
            line = np.exp(-np.pi**2 * x[:, radius] ** 2 / width)
            plane = correlate1d(correlate1d(channel, line, 0, mode="nearest"), line, 1,
                                mode="nearest")
            sums = sums + weight * np.sqrt(np.pi / width) * np.array([plane, line.sum() ** 2
                                                                      * np.ones_like(plane)])
        channels.append(sums[0] / sums[1])
    lightness, red, blue = channels
    y = (lightness + 16) / 116
    xyz = np.stack([y + red / 500, y, y - blue / 200], axis=-1) * WHITE
    return np.clip(xyz @ np.linalg.inv(TO_XYZ).T, 0, 1)


def features(rgb):
    """The strength of edges and of points in the luminance, [2, H, W]."""
    sigma = 0.5 * 0.082 * PIXELS_PER_DEGREE
    x = np.arange(-np.ceil(3 * sigma), np.ceil(3 * sigma) + 1)
    gauss = np.exp(-x**2 / (2 * sigma**2))
    first, second = -x * gauss, (x**2 / sigma**2 - 1) * gauss
    gauss = gauss / gauss.sum()
    first = first / first[first > 0].sum()
    second = np.where(second > 0, second / second[second > 0].sum(),
                      -second / second[second < 0].sum())
    luminance = (opponent(rgb)[..., 0] + 16) / 116
    found = []
    for derivative in (first, second):
        across, down = (correlate1d(correlate1d(luminance, derivative, axis, mode="nearest"), gauss,
                                    1 - axis, mode="nearest") for axis in (1, 0))
        found.append(np.hypot(across, down))
    return np.array(found)


def reference(image, photo):
    one, other = linear(image), linear(photo)
    colour = distance(hunt_lab(filtered(one)), hunt_lab(filtered(other)))
    green, blue = np.array([0.0, 1, 0]), np.array([0.0, 0, 1])
    largest = distance(hunt_lab(green), hunt_lab(blue))
    knee = 0.4 * largest
    colour = np.where(colour < knee, 0.95 / knee * colour,
                      0.95 + (colour - knee) / (largest - knee) * 0.05)
    feature = (np.abs(features(one) - features(other)).max(axis=0) / np.sqrt(2)) ** 0.5
    return colour ** (1 - feature)


def smooth_noise(rng, size):
    noise = rng.random((*size, 3))
    for axis in (0, 1):
        noise = correlate1d(noise, np.ones(3) / 3, axis)
    return noise


@pytest.mark.parametrize("size", [(48, 64), (33, 21)])
def test_the_map_is_that_of_the_paper(size):
    rng = np.random.default_rng(5)
    photo = smooth_noise(rng, size)
    image = np.clip(photo + 0.3 * (smooth_noise(rng, size) - 0.5), 0, 1)
    found, expected = flip_map(image, photo), reference(image, photo)
    assert found.shape == size and found.dtype == np.float32
    # the edges of tiny images differ where a filter is wider than they are
    assert np.abs(found - expected).mean() < 2e-3 and np.abs(found - expected).max() < 0.02
    assert flip(image, photo) == pytest.approx(expected.mean(), abs=1e-3)


def test_its_extremes():
    black = np.zeros((32, 32, 3))
    assert flip(black, black) == 0
    assert flip(black, black + 1) == pytest.approx(0.967, abs=2e-3)
    grey = black + 0.5
    assert 0 < flip(grey, grey + 0.05) < flip(grey, grey + 0.1) < flip(grey, grey + 0.3)
