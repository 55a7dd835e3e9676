"""What each splat contributed to a frame, against the reference and against the frame itself."""

import numpy as np
import pytest

from clsplat.constants import SPLAT_DEPTH
from clsplat.primitives.compact import new_counts
from clsplat.rendering.bin import bin_splats
from clsplat.rendering.blend import blend, blend_defines
from clsplat.rendering.contribution import contribution
from clsplat.rendering.pipeline import Frame
from tests import cases
from tests.checks import close
from tests.kernels.chain import pack_splats, precision_of, render
from tests.reference.blend import fragile_pixels
from tests.reference.contribution import contribution as reference
from tests.reference.contribution import reaches

# in double precision hardly any comparison is so close that rounding decides it
FRAGILE = {"float": 1e-4, "double": 1e-9}


def a_frame(device, rows, size):
    """A Frame of splat rows float64[V, 12], which are stored front to back."""
    width, height = size
    splats = device.upload(rows)
    numbers = device.upload(np.arange(len(rows), dtype=np.uint32))
    counts = new_counts(device, len(rows))
    pairs = bin_splats(device, splats, counts, numbers, width, height)
    blended = blend(device, splats, pairs, width, height, device.upload(np.zeros(3)), blend_defines(with_depth=False))
    return Frame(None, 0, counts, numbers, splats, numbers, pairs, (None,), None, blended, False, 0)


def an_image(width, height, seed=0):
    return cases.single(np.random.default_rng(seed).uniform(0, 50, (height, width)))


def sums_of(device, rows, weights):
    frame = a_frame(device, rows, weights.shape[::-1])
    return contribution(device, frame, device.upload(weights)).download()


def check(device, splats, order, size, what, least_compared=0.5):
    """The sums of the splats that no doubtful pixel is part of; returns the sums of all."""
    precision = precision_of(device)
    weights = an_image(*size)
    fragile = fragile_pixels(splats, order, *size, FRAGILE[precision])
    compared = [not reaches(splats, k, fragile) for k in order]
    assert sum(compared) >= least_compared * len(order), f"{what}: too little is compared"
    actual = sums_of(device, pack_splats(splats, order), weights)
    expected = reference(splats, order, weights)[order]
    # each column for itself: they differ by orders of magnitude
    for column, name in enumerate(("pixels", "weight", "weighted image", "distance")):
        close(actual[compared, column], expected[compared, column], precision, f"{what}: {name}")
    return actual


@pytest.mark.oclgrind
@pytest.mark.parametrize("size", cases.IMAGE_SIZES, ids=str)
def test_sums(device, size):
    check(device, *cases.splats(40, *size, sigma=(0.6, 3)), size, f"{size}", 0.3)


def test_what_lies_behind_an_opaque_stack_contributes_nothing(device):
    splats, order = cases.splats(300, 20, 16, seed=3, opacity=(0.3, 0.9999), sigma=(6, 30))
    actual = sums_of(device, pack_splats(splats, order), an_image(20, 16))
    assert not actual[250:].any() and actual[0].all()
    if precision_of(device) == "double":
        check(device, splats, order, (20, 16), "opaque stack", 1)


@pytest.mark.one_in(2)
def test_a_pixel_ends_before_the_splat_that_would_close_it(double_device):
    """In the middle the first is clamped at 0.99 and the second leaves 2e-4: the third would leave
    less than 1e-4 and is blended further out only."""
    splats, order = cases.splats(3, 16, 16, seed=5, sigma=(3, 4))
    splats["means"][:] = 8.5
    splats["opacities"][order] = cases.single([0.9999, 0.98, 0.6])
    third = check(double_device, splats, order, (16, 16), "nearly opaque", 1)[2]
    alone = sums_of(double_device, pack_splats(splats, order[2:]), an_image(16, 16))[0]
    assert 0 < third[0] < alone[0]


def test_rows_are_those_of_the_visible_gaussians(device):
    """Splats are stored by gaussian, not by depth: each alone has its own count."""
    case = cases.gaussians("degree_1")
    _, _, frame = render(device, case)
    width, height = frame.size
    ones = device.upload(np.ones((height, width)))
    together = contribution(device, frame, ones).download()
    assert len(together) == len(frame.visible) and not np.array_equal(
        np.argsort(frame.splats.download()[:, SPLAT_DEPTH]), np.arange(len(together))
    )
    close(together[:, 2], together[:, 1], precision_of(device), "weights of one")
    for place, row in enumerate(frame.visible.download()):
        alone = {name: values[row : row + 1] for name, values in case["rows"].items()}
        single = contribution(device, render(device, case, alone)[2], ones).download()[0]
        assert together[place, 0] <= single[0] and together[place, 1] <= single[1] * (1 + 1e-6)
        assert single[0] > 1 or place  # the comparison says something
