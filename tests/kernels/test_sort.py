"""Stable radix sort: order, stability, and the sizes where the parts of work-items end."""

import numpy as np
import pytest

from clsplat.primitives import sort
from clsplat.primitives.compact import new_counts
from clsplat.primitives.sort import stable_sort
from tests.reference.sort import sort_order

PARTS = 7
COUNTS = (0, 1, PARTS - 1, PARTS, PARTS + 1, 500, 1031)


@pytest.fixture(autouse=True)
def parts(monkeypatch):
    monkeypatch.setattr(sort, "parts_of", lambda device: PARTS)


def check(device, keys, room=None):
    """Also of a room, whose further keys are not sorted and whose further slots are not written."""
    count, order = len(keys), sort_order(keys)
    in_room = np.append(keys, np.zeros((room or count) - count, np.uint32))
    sorted_keys, permutation = stable_sort(device, device.upload(in_room), new_counts(device, count))
    assert len(sorted_keys) == len(permutation) == len(in_room)
    assert np.array_equal(sorted_keys.download()[:count], keys[order]), count
    assert np.array_equal(permutation.download()[:count], order), count


def random_keys(count, limit=2**32):
    return np.random.default_rng(count).integers(0, limit, count, np.uint32)


@pytest.mark.oclgrind
@pytest.mark.parametrize("spare", [0, 90])
def test_order_around_the_number_of_parts(device, spare):
    for count in COUNTS:
        check(device, random_keys(count), count + spare)


@pytest.mark.oclgrind
def test_few_distinct_keys_keep_their_order(device):
    for distinct in (1, 2, 5):
        check(device, random_keys(1009, distinct))


@pytest.mark.parametrize("bits", [1, 4, 7, 11, 13, 24])
def test_keys_that_differ_in_some_digits_only(device, bits):
    check(device, random_keys(1500 + bits, 2**bits))
    check(device, random_keys(1500 + bits, 2**bits) << np.uint32(32 - bits))


def test_extreme_keys(device):
    """Those past the end are zero, and a real one may equal them."""
    keys = np.resize(np.array([2**32 - 1, 0, 1, 2**31, 2**31 - 1, 2**32 - 1], np.uint32), 515)
    check(device, keys, 600)
    check(device, np.full(515, 2**32 - 1, np.uint32), 600)


def test_slots_past_the_end_are_not_written(device, monkeypatch):
    made, empty = [], device.empty

    def filled(shape, dtype=None):
        made.append(empty(shape, dtype))
        made[-1].fill(77)
        return made[-1]

    counts, keys = new_counts(device, 100), device.upload(random_keys(150))
    monkeypatch.setattr(device, "empty", filled)
    for array in stable_sort(device, keys, counts):
        assert (array.download()[100:] == 77).all()
