"""Gradients of several views as those of one."""

import numpy as np
import pytest

from clsplat.constants import COUNT_FAILED, COUNT_NEEDED_VISIBLE, COUNT_VISIBLE, NO_ROW
from clsplat.device.array import Array
from clsplat.optimise.batch import BatchMean
from clsplat.primitives.compact import new_counts
from clsplat.rendering.project import Gradients
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference import batch as reference

SHAPES = {"positions": (3,), "opacity_logits": (), "sh_rest": (5, 3)}
USED = 2  # degree of the harmonics


def batch_mean(device, count, views, gradients, used, counts=None, room=None):
    """The mean of the gradients of several views, by a BatchMean for `count` rows."""
    rows = {name: device.empty((count, *shape)) for name, shape in SHAPES.items()}
    return mean_of(BatchMean(device, rows, views), gradients, used, counts, room)


def mean_of(batch, gradients, used, counts=None, room=None):
    for each in gradients:
        batch.add(each, used)
    return batch.mean(new_counts(batch.device) if counts is None else counts, used, room)


def a_view(device, count, seen, seed):
    """Gradients by `seen` of `count` rows, every fourth of them not to be followed; and the same
    spread over all rows, with which were seen and which stay."""
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.permutation(count)[:seen]).astype(np.uint32)
    visible = device.upload(rows)
    was_seen, stays = np.zeros((2, count), bool)
    was_seen[rows] = True
    fields = {name: rng.normal(size=(seen, *shape)) for name, shape in SHAPES.items()}
    spread = {name: np.zeros((count, *shape)) for name, shape in SHAPES.items()}
    for name, values in fields.items():
        spread[name][rows] = values
    broken = rng.permutation(seen)[: seen // 4]
    stays[rows[broken]] = True
    rows[broken] = NO_ROW
    for values in fields.values():
        values[broken] = np.nan
    gradients = Gradients(
        {name: device.upload(values) for name, values in fields.items()},
        None,
        device.upload(rows),
        visible,
        new_counts(device, seen),
    )
    return gradients, spread, was_seen, stays


@pytest.mark.double
@pytest.mark.oclgrind
@pytest.mark.parametrize("views, share", [(1, 1.0), (2, 0.5), (4, 0.2), (4, 0.0)])
def test_mean_of_views(device, views, share):
    group = device.group_size
    for count in (1, group - 1, group, group + 1, 3 * group + 7):
        made = [a_view(device, count, int(share * count), seed) for seed in range(views)]
        gradients, spread, seen, stays = zip(*made)
        result = batch_mean(device, count, views, iter(gradients), USED)
        for name in SHAPES:
            visible, moves, mean = reference.batch_mean(
                np.stack([by_name[name] for by_name in spread]), np.stack(seen), np.stack(stays)
            )
            values = result.fields[name].download()
            assert values.shape == mean.shape
            close(values[moves], mean[moves], precision_of(device), f"{name} of {count} rows")
        assert np.array_equal(result.visible.download(), visible)
        assert np.array_equal(result.rows.download(), np.where(moves, visible, NO_ROW))


def padded(device, gradients, count, spare):
    """The same gradients with `spare` slots past the end, which say something about real rows."""

    def longer(array, filling):
        values = array.download()
        return device.upload(
            np.concatenate([values, np.resize(filling, (spare, *values.shape[1:]))]).astype(values.dtype)
        )

    rows = np.arange(count)
    return Gradients(
        {name: longer(values, 5.0) for name, values in gradients.fields.items()},
        None,
        longer(gradients.rows, rows),
        longer(gradients.visible, rows),
        gradients.counts,
    )


@pytest.mark.oclgrind
@pytest.mark.parametrize("more", [0, 1, 50])
def test_a_room_changes_nothing(device, monkeypatch, more):
    """Neither in the views nor in the result; and nothing waits."""
    count = 3 * device.group_size + 7
    made = [a_view(device, count, count // 3, seed)[0] for seed in range(3)]
    exact = batch_mean(device, count, 3, made, USED)
    number = len(exact.visible)
    views, counts = [padded(device, gradients, count, 20) for gradients in made], new_counts(device)
    with monkeypatch.context() as patch:
        patch.setattr(Array, "download", None)
        result = batch_mean(device, count, 3, views, USED, counts, number + more)
    assert result.counts is counts and counts.download()[COUNT_VISIBLE] == number
    assert len(result.rows) == len(result.visible) == number + more
    assert np.array_equal(result.rows.download()[:number], exact.rows.download())
    assert np.array_equal(result.visible.download()[:number], exact.visible.download())
    moves = exact.rows.download() != NO_ROW
    for name, values in result.fields.items():
        assert np.array_equal(values.download()[:number][moves], exact.fields[name].download()[moves])


def test_a_room_that_is_too_small_fails(device):
    gradients, counts = a_view(device, 90, 40, 1)[0], new_counts(device)
    batch_mean(device, 90, 1, [gradients], USED, counts, 39)
    found = counts.download()
    assert found[COUNT_FAILED] == 1 and found[COUNT_NEEDED_VISIBLE] == 40
    assert found[COUNT_VISIBLE] == 0


def test_a_view_that_failed_adds_nothing(device):
    """It is repeated, once there is room, into sums that still have the views before."""
    first, second = (a_view(device, 90, 40, seed)[0] for seed in range(2))
    rows = {name: device.empty((90, *shape)) for name, shape in SHAPES.items()}
    batch, expected = BatchMean(device, rows, 2), batch_mean(device, 90, 2, [first, second], USED)
    batch.add(first, USED)
    seen = second.counts.download()
    failed = np.where(np.arange(len(seen)) == COUNT_FAILED, 1, 0 * seen)  # which sees nothing
    second.counts.write(failed)
    batch.add(second, USED)
    assert batch.mean(second.counts, USED, 90).counts.download()[COUNT_VISIBLE] == 0
    second.counts.write(seen)
    result = mean_of(batch, [second], USED)
    moves = expected.rows.download() != NO_ROW
    assert np.array_equal(result.rows.download(), expected.rows.download())
    for name, values in result.fields.items():
        assert np.array_equal(values.download()[moves], expected.fields[name].download()[moves])
