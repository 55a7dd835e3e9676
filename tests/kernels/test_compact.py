"""The rows that a flag keeps: order, the sizes where chunks end, and rooms that are too small."""

import numpy as np
import pytest

from clsplat import constants
from clsplat.constants import COUNT_MOST_VISIBLE, COUNT_NEEDED_VISIBLE, COUNT_VISIBLE, PER_ITEM
from clsplat.primitives import compact as module
from clsplat.primitives.compact import compact, new_counts
from tests.kernels.chain import UNWRITTEN, longer_arrays
from tests.reference.compact import compact as reference

GROUP = 32
CHUNK = GROUP * PER_ITEM
SIZES = (0, 1, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK + 7)


@pytest.fixture(autouse=True)
def small_chunks(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)
    monkeypatch.setattr(module, "chunk_size", lambda device, count: CHUNK)


def random_flags(count, seed=0):
    return np.random.default_rng(count + seed).integers(0, 2, count).astype(np.uint32)


def into_a_room(device, monkeypatch, flags, counts, room):
    """All `room` slots, and further ones that must stay as they were."""
    with longer_arrays(device, monkeypatch, room, 9) as made:
        kept = compact(device, device.upload(flags), counts, room)
    assert len(kept) == room
    return made[0].download()


@pytest.mark.oclgrind
def test_flagged_rows_are_kept_in_order(device):
    for count in SIZES:
        for flags in (random_flags(count), np.zeros(count, np.uint32), np.ones(count, np.uint32)):
            kept = compact(device, device.upload(flags), new_counts(device))
            assert np.array_equal(kept.download(), reference(flags, count)[0]), count


def test_the_devices_own_chunks(device, monkeypatch):
    monkeypatch.undo()
    count = 3 * PER_ITEM * device.scan_group + 4099
    counts = new_counts(device)
    kept = compact(device, device.upload(random_flags(count)), counts)
    assert np.array_equal(kept.download(), reference(random_flags(count), count)[0])
    assert counts.download()[COUNT_VISIBLE] == len(kept)


@pytest.mark.oclgrind
@pytest.mark.parametrize("more", [0, 1, 100])
def test_a_room_that_is_large_enough(device, monkeypatch, more):
    for count in SIZES[1:]:
        flags, counts = random_flags(count, seed=1), new_counts(device)
        expected, _ = reference(flags, count)
        written = into_a_room(device, monkeypatch, flags, counts, len(expected) + more)
        assert np.array_equal(written[: len(expected)], expected), count
        assert (written[len(expected) :] == UNWRITTEN).all(), count
        found = counts.download()
        assert found[COUNT_VISIBLE] == found[COUNT_MOST_VISIBLE] == len(expected)
        assert not found[constants.COUNT_FAILED] and not found[COUNT_NEEDED_VISIBLE]


@pytest.mark.oclgrind
@pytest.mark.parametrize("fewer", [1, 60])
def test_a_room_that_is_too_small(device, monkeypatch, fewer):
    """Nothing is visible, what is needed is noted, and nothing is written past the room."""
    flags, counts = random_flags(2 * CHUNK + 9), new_counts(device)
    needed = int(flags.sum())
    _, failed = reference(flags, needed - fewer)
    written = into_a_room(device, monkeypatch, flags, counts, needed - fewer)
    found = counts.download()
    assert failed and found[constants.COUNT_FAILED] == 1 and found[COUNT_VISIBLE] == 0
    assert found[COUNT_NEEDED_VISIBLE] == found[COUNT_MOST_VISIBLE] == needed
    assert (written[needed - fewer :] == UNWRITTEN).all()
