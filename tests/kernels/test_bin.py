"""Pairs of tile and splat: none is missing, few are spare, each tile's are in depth order."""

import numpy as np
import pytest

from clsplat.constants import COUNT_PAIRS
from clsplat.device import Device
from clsplat.primitives.compact import new_counts
from clsplat.rendering.bin import TooManyPairs, bin_splats, count_tiles, tile_grid
from tests import cases
from tests.kernels.chain import pack_splats
from tests.reference.bin import tiles_of


def rows_of(count, width, height, seed=0, sigma=(0.3, 40)):
    """Splats in depth order, from far below a pixel to larger than the image, some of them thin."""
    return pack_splats(*cases.splats(count, width, height, seed, sigma=sigma))


class Binned:
    """Splats binned on a device, and what came of it on the host. Without an order, the rows are in
    depth order. The visible splats may be fewer than there are rows."""

    def __init__(self, device, rows, width, height, order=None, visible=None, **options):
        order = np.arange(len(rows)) if order is None else order
        self.frame_counts = new_counts(device, len(rows) if visible is None else visible)
        pairs = bin_splats(
            device,
            device.upload(rows),
            self.frame_counts,
            device.upload(order.astype(np.uint32)),
            width,
            height,
            **options,
        )
        count = int(self.frame_counts.download()[COUNT_PAIRS])
        self.pairs, self.count = pairs, count
        self.counts, self.offsets = pairs.splat_counts.download(), pairs.offsets.download()
        self.emission_indices = pairs.emission_indices.download()[:count]
        self.ranges = pairs.ranges.download().astype(int)
        self.splats = pairs.sorted_splats.download()[:count]
        self.tiles = {v: set() for v in range(len(rows))}
        for tile, (begin, end) in enumerate(self.ranges):
            for v in self.splats[begin:end]:
                self.tiles[v].add((tile % pairs.tiles_x, tile // pairs.tiles_x))

    @property
    def lists(self):
        return self.splats, self.ranges, self.counts


def true_tiles(device, row, tiles_x, tiles_y):
    a, b, c = row[4:7]
    extent = np.sqrt(row[3] * np.array([c, a]) / (a * c - b * b))
    return tiles_of(row[:2], row[4:7], extent, row[3], tiles_x, tiles_y, device.tile)


def check(device, rows, width, height, what, depth_order=None):
    """The Binned, whose pairs are those of the reference, in order."""
    binned = Binned(device, rows, width, height, depth_order)
    truth = [true_tiles(device, row, *tile_grid(device, width, height)) for row in rows]
    for v, tiles in enumerate(truth):
        assert tiles <= binned.tiles[v], f"{what}: splat {v} lacks tiles {tiles - binned.tiles[v]}"
        assert len(binned.tiles[v]) == binned.counts[v], f"{what}: a pair twice, or not emitted"
    needed = sum(map(len, truth))
    assert binned.count == len(binned.pairs.sorted_splats), what
    assert binned.count <= 1.03 * needed + 5, f"{what}: {binned.count} pairs, {needed} are needed"
    is_in_order(binned, depth_order, what)
    return binned


def is_in_order(binned, depth_order=None, what=""):
    """Every tile's pairs are front to back, and a splat's are emitted in the order of its tiles."""
    place = np.arange(len(binned.counts))
    if depth_order is not None:
        place[depth_order] = np.arange(len(place))
    assert binned.counts.sum() == binned.count == np.diff(binned.ranges).sum(), what
    ends = binned.ranges[:, 1]
    assert np.array_equal(binned.ranges[:, 0], np.append(0, ends[:-1])) and ends[-1] == binned.count
    assert np.array_equal(np.sort(binned.emission_indices), np.arange(binned.count)), what
    for begin, end in binned.ranges:
        assert (np.diff(place[binned.splats[begin:end]]) > 0).all(), f"{what}: depth order"
    # sorted by splat, then by tile: a splat's indices are consecutive
    by_splat = np.argsort(binned.splats, kind="stable")
    seen = np.flatnonzero(binned.counts)
    expected = [np.arange(count) + first for count, first in zip(binned.counts[seen], binned.offsets[seen])]
    assert np.array_equal(binned.emission_indices[by_splat], np.concatenate([np.empty(0), *expected])), (
        f"{what}: emission"
    )


@pytest.mark.oclgrind
@pytest.mark.parametrize("size", [(61, 37), (16, 16), (1, 1), (7, 5)])
def test_tiles_hold_every_pixel_that_is_drawn(device, size):
    check(device, rows_of(130, *size), *size, f"{size}")


def test_counts_around_the_group_sizes(device):
    for group in (device.group_size, device.scan_group):
        for count in (0, 1, group - 1, group, group + 1):
            rows = rows_of(count, 61, 37, seed=count, sigma=(0.3, 3))
            check(device, rows, 61, 37, f"{count} splats")


def test_needles_touch_only_the_tiles_along_them(device):
    """A thousand times as long as wide: its box would hold all tiles of the image."""
    rows = rows_of(40, 160, 120)
    for row, angle in zip(rows, np.linspace(0, np.pi, 40)):
        cos, sin, u, v = np.cos(angle), np.sin(angle), 100.0**-2, 0.6**-2
        a, b, c = u * cos**2 + v * sin**2, (u - v) * cos * sin, u * sin**2 + v * cos**2
        row[4:7] = a, b, c
        row[7] = np.sqrt(row[3] * a / (a * c - b * b))
    rows[:] = cases.single(rows)
    binned = check(device, rows, 160, 120, "needles")
    assert binned.counts.max() < 40 and binned.counts.max() >= 9


@pytest.mark.oclgrind
def test_a_band_has_the_pairs_of_its_tiles(device):
    rows = rows_of(130, 61, 37)
    whole = Binned(device, rows, 61, 37)
    tiles = len(whole.ranges)
    assert tiles > 10
    for band in (range(tiles), range(4), range(3, 6), range(5, 6), range(7, tiles)):
        part = Binned(device, rows, 61, 37, band=band)
        assert part.pairs.tiles == band and len(part.ranges) == len(band)
        for (begin, end), (first, last) in zip(part.ranges, whole.ranges[band]):
            assert np.array_equal(part.splats[begin:end], whole.splats[first:last]), band
        first, last = whole.ranges[band.start][0], whole.ranges[band.stop - 1][1]
        assert np.array_equal(part.counts, np.bincount(whole.splats[first:last], minlength=130))
        is_in_order(part, what=f"{band}")


@pytest.mark.oclgrind
@pytest.mark.parametrize("count, size", [(130, (61, 37)), (40, (1, 1)), (0, (61, 37))])
def test_pairs_of_each_tile_are_counted(device, count, size):
    rows = rows_of(count, *size)
    binned = Binned(device, rows, *size)
    counts = count_tiles(device, device.upload(rows), new_counts(device, count), *size)
    assert np.array_equal(counts, np.diff(binned.ranges)[:, 0])
    assert count == 0 or counts.any()


def test_more_pairs_than_the_limit_are_refused(device, monkeypatch):
    rows = rows_of(130, 61, 37)
    count = Binned(device, rows, 61, 37).count
    assert Binned(device, rows, 61, 37, limit=count).count == count
    with pytest.raises(TooManyPairs, match=r"tile and splat in one 61 x 37 image.*\(-r\)"):
        Binned(device, rows, 61, 37, limit=count - 1)
    monkeypatch.setattr("clsplat.rendering.bin.PAIR_LIMIT", count - 1)  # of the kernels' numbers
    with pytest.raises(TooManyPairs, match=f"more than {count - 1}"):
        Binned(device, rows, 61, 37, limit=count)


def test_pairs_of_giants_are_dealt_row_by_row(item_device):
    """To the same pairs in the same order, whatever counts as a giant."""
    rows = rows_of(300, 200, 150, seed=5)
    usual, with_giants = (
        Binned(Device(item_device.handle, form="group", build_options=options), rows, 200, 150)
        for options in ((), ("-DGIANT=8",))
    )
    assert usual.counts.max() > 64
    assert all(map(np.array_equal, usual.lists, with_giants.lists))
    assert np.array_equal(usual.emission_indices, with_giants.emission_indices)
