"""Which pixels of a held-out photo training photos show."""

import numpy as np
import pytest

from clsplat.camera import Camera
from tools.studies.seen import seen_pixels

SIZE, FOCAL, HEIGHT = (40, 30), 40.0, 10.0


def above(x, y=0.0, height=HEIGHT):
    """A camera that looks straight down on the plane z = 0, of which it sees 10 by 7.5."""
    rotation = np.diag([1.0, -1.0, -1.0])
    return Camera(*SIZE, (FOCAL, FOCAL), np.divide(SIZE, 2), rotation, -rotation @ [x, y, height])


@pytest.mark.parametrize(
    "others, first",
    [
        ([above(5), above(5)], 20),
        ([above(0), above(0, 0.5), above(20)], 0),
        ([above(5)], None),
        ([above(5), above(-5)], None),
        ([above(5), above(2.5), above(7.5)], 20),
    ],
)
def test_a_place_counts_from_two_views_on(others, first):
    """On the plane four pixels are a unit, as wide as a cell; those to the right are seen."""
    x, y = np.meshgrid(np.linspace(-20, 20, 81), np.linspace(-20, 20, 81))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    seen = seen_pixels(above(0), points, others)
    assert seen.shape == SIZE[::-1]
    expected = np.zeros(SIZE[::-1], bool)
    if first is not None:
        expected[:, first:] = True
    # at the borders a cell may fall outside by rounding
    assert (seen == expected)[4:-4, 4:-4].all()


def test_what_lies_behind_a_camera_is_not_seen():
    points = np.column_stack([np.linspace(-5, 5, 50), np.linspace(-4, 4, 50), np.zeros(50)])
    assert not seen_pixels(above(0), points, [above(0, 0, -10.0)] * 2).any()
