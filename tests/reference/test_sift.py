"""The reference of SIFT finds analytic blobs where they are and as large, whatever their turn."""

import numpy as np
import pytest

from tests.reference.sift import descriptor, keypoints, orientations, scale_space
from tests.sfm.cases import texture

SIGMA = 1.6


def blob(size, x, y, width=64, height=56):
    rows, columns = np.mgrid[:height, :width] + 0.5
    values = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * size**2))
    return np.repeat((60 + 150 * values)[..., None], 3, 2).round().astype(np.uint8)


@pytest.mark.parametrize("size", [2.5, 3.5, 5.0])
def test_a_blob_has_its_place_and_size(size):
    """Normalised by scale, the Laplacian of a Gaussian of sigma `size` is largest at that scale
    (Lindeberg 1998); the difference of two levels lies between these, a sixth of an octave up."""
    rows, _ = keypoints(scale_space(blob(size, 30.2, 27.7), 64, 56))
    x, y, level, octave = rows[
        np.argmin(np.hypot(rows[:, 0] * 2 ** rows[:, 3] + 0.5 - 30.2, rows[:, 1] * 2 ** rows[:, 3] + 0.5 - 27.7))
    ]
    assert np.hypot(x * 2**octave + 0.5 - 30.2, y * 2**octave + 0.5 - 27.7) < 0.1
    found = SIGMA * 2 ** (level / 3 + octave + 1 / 6)
    assert found == pytest.approx(size, rel=0.06)


def test_an_edge_and_a_weak_blob_are_no_features():
    edge = np.full((56, 64, 3), 40, np.uint8)
    edge[:, 31:] = 200
    weak = blob(3.5, 30, 28).astype(float) * 0.02 + 90
    for pixels in (edge, weak.round().astype(np.uint8)):
        assert not len(keypoints(scale_space(pixels, 64, 56))[0])


def test_a_quarter_turn_changes_angles_alone():
    pixels = texture(48, 64, 3)
    both = []
    for image in (pixels, np.rot90(pixels, -1)):
        octaves = scale_space(image, *image.shape[1::-1])[:1]  # the next begin at other pixels
        rows, _ = keypoints(octaves)
        both.append(
            [(row, angle, descriptor(octaves, row, angle)) for row in rows for angle in orientations(octaves, row)[:1]]
        )
    turned = {(round(47 - row[1], 3), round(row[0], 3)): (angle, values) for row, angle, values in both[0]}
    assert len(turned) > 8 and len(both[1]) == len(turned)
    for row, angle, values in both[1]:
        before, expected = turned[round(row[0], 3), round(row[1], 3)]
        assert np.abs(values - expected).max() < 1e-6
        assert np.cos(angle - before - np.pi / 2) == pytest.approx(1, abs=1e-9)
