"""What a round of growth makes of the gaussians, as the schedule selects them."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.options import TrainOptions
from clsplat.schedule import Plan, SceneFacts, Schedule
from clsplat.training.growth import Round

COUNT = 6
GRADIENT = np.array([3e-4, 1e-4, 2e-4, 9e-4, 0.0, 5e-4])
PLAN = Plan(level=1.0, degree=0, gathers=True, grows=True, resets_opacity=False, prunes_large=False,
            decay=0.0)


class Other(Schedule):
    """As another package may have it: without a target, but for one that a test gives it."""

    most = None

    def target(self, iteration, count, above):
        return self.most


def a_round(selection, most=None, frozen=()):
    """A round of small gaussians, of which none is split."""
    options = TrainOptions()
    schedule = Other(options, SceneFacts((640, 480), COUNT, 1.0, photos=None, pixels=1))
    schedule.selection, schedule.most = selection, most
    rng = np.random.default_rng(0)
    rows = {"positions": rng.normal(size=(COUNT, 3)), "log_scales": np.full((COUNT, 3), -9.0),
            "opacity_logits": np.full(COUNT, 2.0), "quaternions": rng.normal(size=(COUNT, 4))}
    on_device = {name: SimpleNamespace(download=lambda values=values: values.astype(np.float32))
                 for name, values in rows.items()}
    return Round(501, PLAN, schedule, options, 1.0, lambda: GRADIENT,
                 np.isin(np.arange(COUNT), frozen)).growth(None, on_device, list)


def grown(selection, most=None, frozen=()):
    """The sources of the clones of a round."""
    growth = a_round(selection, most, frozen)
    assert growth.kept == COUNT and growth.source[:COUNT].tolist() == list(range(COUNT))
    return growth.source[COUNT:].tolist()


@pytest.mark.parametrize("selection", ["threshold", "highest"])
def test_without_a_target_all_that_reach_the_threshold_grow(selection):
    assert grown(selection) == [0, 2, 3, 5]
    assert grown(selection, frozen=(3, 4)) == [0, 2, 5]


@pytest.mark.parametrize("selection, most, chosen", [
    ("threshold", 8, [3, 5]), ("threshold", 20, [0, 2, 3, 5]), ("highest", 8, [3, 5]),
    ("highest", 20, [0, 1, 2, 3, 5]), ("threshold", 3, []), ("highest", 3, [])])
def test_a_target_limits_the_round(selection, most, chosen):
    assert grown(selection, most) == chosen
