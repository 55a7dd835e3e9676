"""Screen gradients and visibility, which the adjoint of projection sums over views."""

import numpy as np
import pytest

from clsplat.constants import COUNT_FAILED, COUNT_VISIBLE, NO_ROW
from clsplat.densify.scores import Statistics
from clsplat.primitives.compact import new_counts
from clsplat.rendering.pipeline import Room
from tests import cases
from tests.checks import close
from tests.kernels.chain import camera_of, precision_of, renderer_of, size_of, upload_rows
from tests.reference.statistics import accumulate


class Views:
    """Gaussians, their Statistics, and the same sums by the reference."""

    def __init__(self, device, count, name="degree_1"):
        self.device, self.name = device, name
        self.case = cases.gaussians(name, count=count)
        self.rows = upload_rows(device, self.case["rows"])
        self.renderer = renderer_of(device, self.case)
        self.statistics = Statistics(device, count)
        self.expected = np.zeros(count), np.zeros(count, np.uint32)

    def see(self, seed, room=None, frozen=None, spoilt=0.0, counts=None, **size):
        """Add a view with random gradients, of which a share of the image's rows is not finite; the
        gradients of the frame."""
        case = {**self.case, "camera": cases.gaussians(self.name, **size)["camera"]}
        width, height = size_of(case)
        grad = np.random.default_rng(seed).normal(size=(3, height, width))
        grad[:, : int(spoilt * height)] = np.nan
        frame = self.renderer.render(
            self.rows, self.renderer.pack(camera_of(case)), width, height, case["degree"], room=room, counts=counts
        )
        gradients = self.renderer.adjoint(
            self.rows,
            frame,
            self.device.upload(grad),
            statistics=self.statistics.sums,
            frozen=None if frozen is None else self.device.upload(frozen.astype(np.uint32)),
        )
        number = gradients.counts.download()[COUNT_VISIBLE]
        rows = gradients.rows.download()[:number]
        means = gradients.means.download()[:number]
        spread = np.zeros((len(self.expected[0]), 2))
        visible = np.zeros(len(spread), bool)
        spread[rows[rows != NO_ROW]] = means[rows != NO_ROW]
        visible[rows[rows != NO_ROW]] = True
        self.expected = accumulate(*self.expected, spread, visible, width, height)
        return gradients

    def check(self, what=""):
        norms, seen = self.expected
        precision = precision_of(self.device)
        assert np.array_equal(self.statistics.seen_count.download(), seen), what
        close(self.statistics.grad_norm_sum.download(), norms, precision, what)
        close(self.statistics.mean_gradient(), norms / np.maximum(seen, 1), precision, what)


@pytest.mark.oclgrind
def test_sums_over_views(device):
    group = device.group_size
    for count in (1, group - 1, group, group + 1):
        views = Views(device, count)
        for seed, (width, height) in enumerate(((64, 48), (61, 37), (17, 33))):
            views.see(seed, width=width, height=height)
        assert views.expected[1].max() == 3
        views.check(f"{count} rows")


def test_what_is_not_finite_or_frozen_does_not_count(device):
    views = Views(device, 200)
    frozen = np.arange(200) % 3 == 0
    whole, *others = (
        views.see(1),
        views.see(2, spoilt=0.4),
        views.see(3, frozen=frozen),
        views.see(4, frozen=frozen, spoilt=0.4),
    )
    left_out = [(gradients.rows.download() == NO_ROW).sum() for gradients in (whole, *others)]
    assert left_out[0] == 0 < min(left_out[1:3]) and max(left_out[1:3]) < left_out[3]
    views.check()
    seen = whole.visible.download()
    assert (views.expected[1][seen[frozen[seen]]] <= 2).all()


def test_rows_that_are_frozen(device):
    """Their gradients are left out, and not counted as not finite; the others are as they were."""
    views = Views(device, 200)
    frozen = (np.arange(200) % 3 == 0) * np.random.default_rng(0).integers(1, 2**31, 200)
    whole, part = views.see(1), views.see(1, frozen=frozen)
    rows = whole.rows.download()
    assert np.array_equal(part.rows.download(), np.where(frozen[rows] > 0, NO_ROW, rows))
    assert np.array_equal(part.visible.download(), rows)
    assert views.renderer.skipped.download()[0] == 0
    moves = frozen[rows] == 0
    for name, values in part.fields.items():
        assert np.array_equal(values.download()[moves], whole.fields[name].download()[moves]), name


def test_a_frame_that_failed_adds_nothing(device):
    views, counts = Views(device, 60), new_counts(device)
    views.see(1)
    views.see(2, room=Room(5, 5000), counts=counts)
    assert counts.download()[COUNT_FAILED]
    views.check()


def test_slots_past_the_visible_gaussians_do_not_count(device):
    """There is room for more than a view sees."""
    views = Views(device, 60)
    number = len(views.see(1).rows)
    assert len(views.see(2, room=Room(number + 30, 5000)).rows) == number + 30
    views.check()
