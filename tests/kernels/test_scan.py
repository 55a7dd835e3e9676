"""Exclusive prefix sums, around the sizes of chunks and groups."""

import numpy as np
import pytest

from clsplat.constants import PER_ITEM
from clsplat.primitives import scan
from tests.reference.scan import exclusive_scan

GROUP = 64
CHUNK = GROUP * PER_ITEM
COUNTS = (0, 1, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK + 7)


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(scan, "SMALLEST_CHUNK", CHUNK)


def check(device, values):
    offsets, totals = scan.exclusive_scan(device, device.upload(values))
    expected, total = exclusive_scan(values)
    assert np.array_equal(offsets.download(), expected.astype(np.uint32)), len(values)
    assert totals.last() == total


@pytest.mark.oclgrind
def test_sums_around_chunk_sizes(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)
    for count in COUNTS:
        check(device, np.random.default_rng(count).integers(0, 1000, count, np.uint32))


def test_more_chunks_than_lanes_add_up_their_totals(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)
    monkeypatch.setattr(scan, "chunk_size", lambda device, count: CHUNK)
    count = (2 * GROUP + 1) * CHUNK + 3
    check(device, np.random.default_rng(0).integers(0, 1000, count, np.uint32))


def test_the_devices_own_group_size(device):
    count = 3 * PER_ITEM * device.scan_group + 7
    check(device, np.random.default_rng(1).integers(0, 9, count, np.uint32))


def test_the_total_has_64_bits(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)
    check(device, np.full(2 * CHUNK + 5, 2**32 - 1, np.uint32))


def test_all_zeros(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)
    check(device, np.zeros(CHUNK + 1, np.uint32))
