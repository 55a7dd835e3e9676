"""Lists of pairs that are long, whose splats are many tiles large or equally deep, and rooms for
pairs that are larger than needed, just large enough or too small."""

import numpy as np
import pytest

from clsplat import constants
from clsplat.primitives.compact import new_counts
from clsplat.rendering import bin
from clsplat.rendering.bin import HAS_BUCKETS, TooManyPairs, bin_splats
from tests.kernels.chain import UNWRITTEN, longer_arrays
from tests.kernels.test_bin import Binned, check, is_in_order, rows_of

GROUP = 64  # of 32, Intel's compiler crashes
RUN = GROUP * constants.PER_ITEM  # pairs that a group sorts at once


@pytest.fixture
def small_groups(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)


def shuffled(rows, seed=0, depths=None):
    """(rows in random order, with these depths or their own; the order that sorts them)."""
    rng = np.random.default_rng(seed)
    rows = rows[rng.permutation(len(rows))]
    if depths is not None:
        rows[:, constants.SPLAT_DEPTH] = rng.choice(depths, len(rows))
    return rows, np.argsort(rows[:, constants.SPLAT_DEPTH].astype(np.float32), kind="stable")


def specks(count, column, row, seed=0):
    """Splats in the middle of one tile, all of whose pixels they are far from leaving."""
    rows = rows_of(count, 16, 16, seed, sigma=(0.3, 0.5))
    rows[:, constants.SPLAT_MEAN : constants.SPLAT_MEAN + 2] = 16 * column + 8, 16 * row + 8
    return rows


@pytest.mark.oclgrind
@pytest.mark.parametrize("count", [RUN - 1, RUN, RUN + 1, 2 * RUN, 2 * RUN + 1])
@pytest.mark.one_in(5)
def test_lists_around_the_length_that_is_sorted_at_once(device, small_groups, count):
    rows, order = shuffled(specks(count, 1, 1, seed=count))
    binned = check(device, rows, 48, 48, f"{count} pairs", order)
    assert np.diff(binned.ranges).max() == count


@pytest.mark.parametrize("count", [3 * RUN, 4 * RUN + 1, 5 * RUN - 1, 9 * RUN + 100])
def test_longer_lists_are_merged(device, small_groups, count):
    """Several merges, with a last run that is shorter or has no partner; beside other lists."""
    rows = np.concatenate(
        [specks(count, 2, 0), specks(RUN + 5, 0, 1, seed=1), rows_of(200, 48, 48, seed=2, sigma=(0.3, 4))]
    )
    rows, order = shuffled(rows, depths=np.linspace(1, 2, 5 * count))
    binned = Binned(device, rows, 48, 48, order)
    is_in_order(binned, order, f"{count} pairs")
    assert np.diff(binned.ranges).max() >= count


def test_the_devices_own_groups_sort_long_lists(device):
    for count in (1, constants.PER_ITEM) if device.scan_group < 256 else (2047, 2048, 2049, 4096, 5000, 9000):
        rows, order = shuffled(specks(count, 0, 1, seed=count))
        binned = Binned(device, rows, 32, 32, order)
        is_in_order(binned, order, f"{count} pairs")
        assert np.diff(binned.ranges).max() == count


def test_more_tiles_and_more_splats_than_a_group_places_at_once(device, small_groups):
    """Their numbers are added up in several rounds; the last one is not complete."""
    rows, order = shuffled(rows_of(GROUP * RUN + 35, 400, 370, sigma=(0.3, 2)))
    binned = Binned(device, rows, 400, 370, order)
    is_in_order(binned, order)
    assert len(binned.ranges) == 25 * 24 > RUN and binned.count > len(rows)


@pytest.mark.oclgrind
def test_equal_depths_keep_the_order_of_rows(device, small_groups):
    for depths in ([2.0], [1.0, 1.5, 3.0]):
        rows, order = shuffled(rows_of(150, 61, 37, seed=4), depths=depths)
        check(device, rows, 61, 37, f"depths {depths}", order)


def giants(rows, chosen):
    """The same rows, of which `chosen` are larger than any image."""
    rows[chosen, constants.SPLAT_CONIC : constants.SPLAT_EXTENT_Y + 1] = 1e-9, 0, 1e-9, 1e5
    return rows


@pytest.mark.oclgrind
@pytest.mark.parametrize("size", [(160, 120), (1100, 37)], ids=str)
def test_splats_with_many_tiles_beside_small_ones(device, small_groups, size):
    """More tiles than a single work-item emits, in rows of fewer and of more than a group."""
    chosen = [0, 1, 30, 31, 32, 69]
    rows, order = shuffled(giants(rows_of(70, *size, sigma=(0.3, 9)), chosen))
    binned = Binned(device, rows, *size, order)
    is_in_order(binned, order, f"{size}")
    tiles = len(binned.ranges)
    assert tiles > 64 and (binned.counts == tiles).sum() == len(chosen)


@pytest.mark.slow
def test_more_pairs_than_32_bits_count(float_device, monkeypatch):
    """All in one part of the item form: the number must not begin again at 0."""
    monkeypatch.setattr(bin, "parts_of", lambda device: 1)
    size = 512 * float_device.tile
    count = 2**32 // 512**2 + 4
    rows, order = shuffled(giants(specks(count, 0, 0), range(count)))
    with pytest.raises(TooManyPairs, match="^4294967295 pairs"):
        bin_splats(
            float_device,
            float_device.upload(rows),
            new_counts(float_device, count),
            float_device.upload(order.astype(np.uint32)),
            size,
            size,
            limit=1000,
        )


def in_a_room(device, monkeypatch, rows, order, room, counts=None, size=(61, 37)):
    """(Pairs, counts on the host, the two lists with slots past their end, which must stay)."""
    counts = new_counts(device, len(rows)) if counts is None else counts
    splats, order = device.upload(rows), device.upload(order.astype(np.uint32))
    with longer_arrays(device, monkeypatch, room, 40) as made:
        pairs = bin_splats(device, splats, counts, order, *size, room=room)
    written = [array.download() for array in made]
    assert len(pairs.sorted_splats) == room == pairs.count
    assert all((values[room:] == UNWRITTEN).all() for values in written)
    return pairs, counts.download(), written[:2]


@pytest.mark.oclgrind
@pytest.mark.parametrize("more", [0, 1, 777])
def test_a_room_that_is_large_enough_changes_nothing(device, monkeypatch, more):
    rows, order = shuffled(rows_of(130, 61, 37))
    exact = Binned(device, rows, 61, 37, order)
    pairs, counts, lists = in_a_room(device, monkeypatch, rows, order, exact.count + more)
    assert np.array_equal(lists[0][: exact.count], exact.splats)
    assert np.array_equal(lists[1][: exact.count], exact.emission_indices)
    assert all((values[exact.count :] == UNWRITTEN).all() for values in lists)
    assert np.array_equal(pairs.ranges.download(), exact.ranges)
    assert np.array_equal(pairs.offsets.download(), exact.offsets)
    assert counts[constants.COUNT_PAIRS] == counts[constants.COUNT_MOST_PAIRS] == exact.count
    assert counts[constants.COUNT_VISIBLE] == 130 and not counts[constants.COUNT_FAILED]
    if HAS_BUCKETS.of(device):
        buckets, number = pairs.bucket_tiles.download(), counts[constants.COUNT_BUCKETS]
        lengths = np.diff(exact.ranges)[:, 0]
        expected = np.repeat(np.arange(len(lengths)), -(-lengths // device.bucket))
        assert np.array_equal(buckets[:number], expected) and not buckets[number:].any()


@pytest.mark.oclgrind
@pytest.mark.parametrize("fewer", [1, 300])
def test_a_room_that_is_too_small_fails_the_frame(device, monkeypatch, fewer):
    rows, order = shuffled(rows_of(130, 61, 37))
    needed = Binned(device, rows, 61, 37, order).count
    pairs, counts, lists = in_a_room(device, monkeypatch, rows, order, needed - fewer)
    assert counts[constants.COUNT_FAILED] == 1 and counts[constants.COUNT_NEEDED_PAIRS] == needed
    for nothing in (constants.COUNT_VISIBLE, constants.COUNT_PAIRS, constants.COUNT_BUCKETS):
        assert counts[nothing] == 0
    assert counts[constants.COUNT_MOST_PAIRS] == needed and not counts[constants.COUNT_SUM_PAIRS]
    assert not np.diff(pairs.ranges.download().astype(int)).any()
    assert all((values == UNWRITTEN).all() for values in lists)


def test_the_sum_of_pairs_has_64_bits(device, monkeypatch):
    rows, order = shuffled(rows_of(130, 61, 37))
    counts, values = new_counts(device), np.zeros(constants.FRAME_COUNTS, np.uint32)
    low = constants.COUNT_SUM_PAIRS
    values[[constants.COUNT_VISIBLE, low, low + 1]] = 130, 2**32 - 10, 4
    counts.write(values)
    for frames in (1, 2):
        found = in_a_room(device, monkeypatch, rows, order, 5000, counts)[1]
        assert int(found[low]) + (int(found[low + 1]) << 32) == 5 * 2**32 - 10 + frames * int(
            found[constants.COUNT_PAIRS]
        )
