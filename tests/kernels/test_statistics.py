"""Screen gradients and visibility, summed over views."""

import numpy as np
import pytest

from clsplat.constants import NO_ROW
from clsplat.densify.statistics import Statistics
from clsplat.primitives.compact import new_counts
from clsplat.rendering.pipeline import Gradients
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference.statistics import accumulate


def a_view(device, count, seen, seed):
    """Gradients of `seen` of `count` gaussians, some not finite; and the same spread over rows."""
    rng = np.random.default_rng(seed)
    rows = rng.permutation(count)[:seen].astype(np.uint32)
    means = rng.normal(size=(seen, 2)) * 1e-3
    broken = rng.random(seen) < 0.2
    seen_rows = device.upload(rows)
    spread, visible = np.zeros((count, 2)), np.zeros(count, bool)
    spread[rows[~broken]], visible[rows[~broken]] = means[~broken], True
    means[broken], rows[broken] = np.nan, NO_ROW
    gradients = Gradients({}, device.upload(means), device.upload(rows), seen_rows,
                          new_counts(device, seen))
    return gradients, spread, visible


@pytest.mark.oclgrind
def test_sums_over_views(device):
    group = device.group_size
    for count in (1, group - 1, group, group + 1, 3 * group + 7):
        statistics = Statistics(device, count)
        norms, seen_count = np.zeros(count), np.zeros(count, np.uint32)
        for seed, (width, height) in enumerate(((640, 480), (61, 37), (1, 1))):
            gradients, spread, visible = a_view(device, count, max(1, count * 2 // 3), seed)
            statistics.accumulate(gradients, width, height)
            norms, seen_count = accumulate(norms, seen_count, spread, visible, width, height)
        assert np.array_equal(statistics.seen_count.download(), seen_count)
        close(statistics.grad_norm_sum.download(), norms, precision_of(device), f"{count} rows")
        close(statistics.mean_gradient(), norms / np.maximum(seen_count, 1),
              precision_of(device), "mean")


def test_a_view_that_sees_nothing_and_a_fresh_start(device):
    statistics = Statistics(device, 5)
    statistics.accumulate(a_view(device, 5, 4, 7)[0], 48, 40)
    before = statistics.grad_norm_sum.download()
    assert before.any()
    statistics.accumulate(a_view(device, 5, 0, 8)[0], 48, 40)
    assert np.array_equal(statistics.grad_norm_sum.download(), before)
    statistics.clear(7)
    assert statistics.mean_gradient().shape == (7,) and not statistics.mean_gradient().any()


def test_slots_past_the_visible_gaussians_do_not_count(device):
    """There is room for more than a view has seen."""
    rows = np.random.default_rng(9).permutation(60)[:50].astype(np.uint32)
    on_device, statistics = device.upload(rows), Statistics(device, 60)
    statistics.accumulate(Gradients({}, device.upload(np.ones((50, 2))), on_device, on_device,
                                    new_counts(device, 31)), 48, 40)
    seen = np.isin(np.arange(60), rows[:31])
    assert np.array_equal(statistics.seen_count.download(), seen)
    assert np.array_equal(statistics.grad_norm_sum.download() > 0, seen)
