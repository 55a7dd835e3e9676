"""Stable radix sort: order, stability, and the sizes where chunks, digits and padding end."""

import numpy as np
import pytest

from clsplat.constants import PER_ITEM
from clsplat.primitives import scan
from clsplat.primitives.sort import stable_sort
from tests.reference.sort import sort_order

GROUP = 64
CHUNK = GROUP * PER_ITEM
COUNTS = (0, 1, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK + 7)


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(scan, "SMALLEST_CHUNK", CHUNK)


def check(device, keys, bits=32):
    order = sort_order(keys)
    sorted_keys, permutation = stable_sort(device, device.upload(keys), bits)
    assert np.array_equal(sorted_keys.download(), keys[order]), (len(keys), bits)
    assert np.array_equal(permutation.download(), order), (len(keys), bits)


def random_keys(count, limit=2**32):
    return np.random.default_rng(count).integers(0, limit, count, np.uint32)


@pytest.mark.oclgrind
def test_order_around_chunk_sizes(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)
    for count in COUNTS:
        check(device, random_keys(count))


@pytest.mark.oclgrind
def test_few_distinct_keys_keep_their_order(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)
    for distinct in (1, 2, 5):
        check(device, random_keys(2 * CHUNK + 9, distinct), bits=3)


@pytest.mark.parametrize("bits", [1, 4, 7, 13, 24])
def test_odd_and_even_digits(device, bits):
    check(device, random_keys(3 * CHUNK + bits, 2**bits), bits)


def test_extreme_keys(device):
    """Padding at the end of a chunk carries the largest key there is; a real one may equal it."""
    keys = np.resize(np.array([2**32 - 1, 0, 1, 2**31, 2**31 - 1, 2**32 - 1], np.uint32), CHUNK + 3)
    check(device, keys)
    check(device, np.full(CHUNK + 3, 2**32 - 1, np.uint32))


def test_positive_floats_order_as_their_bits(device):
    depths = np.exp(np.random.default_rng(0).normal(0, 9, 3000)).astype(np.float32)
    _, order = stable_sort(device, device.upload(depths.view(np.uint32)))
    assert np.array_equal(order.download(), np.argsort(depths, kind="stable"))


def test_sorted_and_reversed_keys(device):
    keys = np.sort(random_keys(2000))
    check(device, keys)
    check(device, keys[::-1].copy())
