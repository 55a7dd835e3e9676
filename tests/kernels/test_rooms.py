"""Frames with rooms: nothing waits, and the bytes are those of a frame of exact sizes."""

import numpy as np
import pytest

from clsplat import constants
from clsplat.device.array import Array
from clsplat.primitives.compact import new_counts
from clsplat.rendering.contribution import contribution
from clsplat.rendering.pipeline import Room
from tests import cases
from tests.kernels.chain import camera_of, gradients_by_row, renderer_of, size_of, upload_rows
from tests.kernels.test_pipeline import assert_same, cotangents


class Rendered:
    """A frame with depth and all that comes of it, none of which waits where it has a room."""

    def __init__(self, device, case, room=None, counts=None, pair_limit=None):
        renderer = renderer_of(device, case, pair_limit=pair_limit)
        rows, camera = upload_rows(device, case["rows"]), renderer.pack(camera_of(case))
        grads = [device.upload(values) for values in cotangents(case)]
        weights = device.upload(np.random.default_rng(2).random(size_of(case)[::-1]))
        with pytest.MonkeyPatch.context() as patch:
            if room:
                patch.setattr(Array, "download", None)
            self.frame = frame = renderer.render(rows, camera, *size_of(case), case["degree"], True, room, counts)
            gradients = renderer.adjoint(rows, frame, *grads)
            sums = contribution(device, frame, weights)
        self.counts = frame.counts.download()
        self.number = number = self.counts[constants.COUNT_VISIBLE]
        self.visible = frame.visible.download()[:number]
        self.rows = gradients.rows.download()[:number]
        self.arrays = [
            frame.image.download(),
            frame.blended.depth.download(),
            frame.blended.transmittance.download(),
            sums.download()[:number],
            gradients.means.download()[:number],
            self.visible,
            self.rows,
            *gradients_by_row(gradients, case).values(),
        ]
        self.skipped = renderer.skipped.download()[0]

    def room(self, visible=0, pairs=0, **bands):
        """That of this frame, with more or fewer slots."""
        return Room(len(self.frame.visible) + visible, int(self.counts[constants.COUNT_PAIRS]) + pairs, **bands)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["degree_1", "giants", "many"])
@pytest.mark.parametrize("visible, pairs", [(0, 0), (1, 1), (300, 5000)])
@pytest.mark.one_in(4)
def test_a_room_that_is_large_enough_changes_nothing(device, name, visible, pairs):
    case = cases.gaussians(name, count=300)
    exact = Rendered(device, case)
    roomy = Rendered(device, case, exact.room(visible, pairs), new_counts(device))
    assert len(roomy.frame.visible) == len(exact.visible) + visible
    assert roomy.frame.pairs.count == exact.frame.pairs.count + pairs
    assert roomy.counts[constants.COUNT_PAIRS] == exact.frame.pairs.count and roomy.number > 100
    assert not roomy.counts[constants.COUNT_FAILED] and roomy.skipped == exact.skipped
    assert_same(exact.arrays, roomy.arrays)


@pytest.mark.oclgrind
def test_a_small_frame_with_a_room(device):
    case = cases.gaussians("degree_1", count=40)
    exact = Rendered(device, case)
    assert_same(exact.arrays, Rendered(device, case, exact.room(9, 70)).arrays)


@pytest.mark.parametrize("more", [0, 1000])
@pytest.mark.one_in(3)
def test_bands_with_a_room(device, more):
    case = cases.gaussians("giants", count=200)
    whole = Rendered(device, case)
    banded = Rendered(device, case, pair_limit=int(0.3 * whole.counts[constants.COUNT_PAIRS]))
    assert len(banded.frame.bands) > 3
    largest = int(0.3 * whole.counts[constants.COUNT_PAIRS])
    room = Room(len(whole.visible) + more, largest + more, banded.frame.bands)
    roomy = Rendered(device, case, room)
    assert roomy.frame.bands == banded.frame.bands and roomy.frame.pairs is None
    assert_same(whole.arrays, roomy.arrays)
    # once for the image, once each for the adjoint and the contributions
    assert roomy.counts[constants.COUNT_SUM_PAIRS] == 3 * whole.counts[constants.COUNT_PAIRS]


@pytest.mark.parametrize(
    "visible, pairs, what",
    [
        (-1, 0, constants.COUNT_NEEDED_VISIBLE),
        (0, -1, constants.COUNT_NEEDED_PAIRS),
        (-50, -300, constants.COUNT_NEEDED_VISIBLE),
    ],
)
def test_a_room_that_is_too_small_fails(device, visible, pairs, what):
    """The frame sees nothing, shows the background, and says what it would have needed."""
    case = cases.gaussians("degree_1", count=200)
    exact = Rendered(device, case)
    needed = {
        constants.COUNT_NEEDED_VISIBLE: exact.number,
        constants.COUNT_NEEDED_PAIRS: exact.counts[constants.COUNT_PAIRS],
    }
    failed = Rendered(device, case, exact.room(visible, pairs))
    assert failed.counts[constants.COUNT_FAILED] == 1 and failed.counts[what] == needed[what]
    assert failed.number == failed.counts[constants.COUNT_PAIRS] == failed.skipped == 0
    background = np.asarray(case["background"], device.real)
    assert (failed.arrays[0] == background[:, None, None]).all() and (failed.arrays[2] == 1).all()


def test_frames_after_a_failure_see_nothing_until_it_is_cleared(device):
    case, other = (cases.gaussians("degree_1", count=count) for count in (200, 80))
    exact, counts = Rendered(device, other), new_counts(device)
    Rendered(device, case, exact.room(), counts)
    again = Rendered(device, other, exact.room(), counts)
    assert again.counts[constants.COUNT_FAILED] == 1 and again.number == 0
    counts.fill(0)
    assert_same(exact.arrays, Rendered(device, other, exact.room(), counts).arrays)
