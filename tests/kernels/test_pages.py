"""Pages of rows beside plain arrays, and which pages a view wants."""

import numpy as np
import pytest

from clsplat.constants import CATCH_UP_EVERY, COUNT_FAILED, LACKS_PAGE, PAGE_ABSENT, PAGE_ROWS
from clsplat.errors import InputError, TooFewPages
from clsplat.optimise.page_store import PageStore, spatial_order
from clsplat.optimise.pages import Pages
from clsplat.primitives.compact import new_counts
from clsplat.rendering.cull import cull
from tests.kernels.test_lazy_adam import DEFINES, Lazy
from tests.reference.pages import rest_rows, wanted_pages

WIDTHS = {"sh_rest": ((9,), np.float32), "m_rest": ((9,), np.uint16), "v_rest": ((9,), np.uint8)}
COUNT = 5 * PAGE_ROWS + 100  # six pages


def values_of(count, seed):
    rng = np.random.default_rng(seed)
    return {name: rng.integers(1, 200, (count, *shape)).astype(dtype) for name, (shape, dtype) in WIDTHS.items()}


def pages_of(device, room, count=COUNT):
    """(Pages with this many slots, the positions and values of its rows)."""
    positions = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    values, found = values_of(count, 1), []
    store = PageStore(positions, values)
    found.append(Pages(device, store, lambda: room * store.page_bytes))
    return found[0], positions, values


def wanting(*pages, of=6):
    wanted = np.zeros(of, bool)
    wanted[list(pages)] = True
    return wanted


def test_rows_near_each_other_share_a_page():
    positions = np.random.default_rng(0).uniform(size=(16 * PAGE_ROWS, 3))
    positions[7] = np.nan
    order = spatial_order(positions)
    assert np.array_equal(np.sort(order), np.arange(len(positions)))
    extents = np.nanmax(positions[order].reshape(16, PAGE_ROWS, 3), axis=1) - np.nanmin(
        positions[order].reshape(16, PAGE_ROWS, 3), axis=1
    )
    assert np.median(extents.max(axis=1)) < 0.6  # of 1


@pytest.fixture(params=[1 << 24, 20_000])
def blocks(request, monkeypatch):
    """All pages in one block of host memory, or two to eight in each."""
    monkeypatch.setattr("clsplat.optimise.page_store.BLOCK_WORDS", request.param)


@pytest.mark.oclgrind
def test_pages_come_and_go_as_arrays_would_stay(float_device, blocks):
    """Rows of pages that are there change, over and over; in the end each has its changes."""
    pages, _, values = pages_of(float_device, 3)
    rng = np.random.default_rng(2)
    for _ in range(20):
        wanted = wanting(*rng.choice(6, rng.integers(1, 4), replace=False))
        pages.fetch(wanted)
        slots = pages.slots.download()
        there = slots < 2**31
        assert there[wanted].all() and there.sum() <= 3
        places = pages.places.download()
        rows = np.flatnonzero(wanted[places // PAGE_ROWS])
        lies = pages.rest_of(float_device.upload(rows.astype(np.uint32))).download()
        assert np.array_equal(lies, rest_rows(rows, places, slots, PAGE_ROWS))
        pages.note_change()
        for name, array in pages.arrays.items():
            present = array.download()
            assert np.array_equal(present[lies], values[name][rows]), name
            changed = values[name][rows] + np.asarray(rng.integers(1, 3), values[name].dtype)
            present[lies] = values[name][rows] = changed
            array.write(present)
    for name in values:
        assert np.array_equal(pages.download(name), values[name]), name
    with pytest.raises(TooFewPages, match="memory-budget"):
        pages.fetch(wanting(0, 1, 2, 3))
    seen = np.concatenate([pages.store.rows_of(group) for group in pages.rounds()])
    assert np.array_equal(np.sort(seen), np.arange(COUNT))


def test_pages_follow_growth(float_device, blocks):
    pages, positions, values = pages_of(float_device, 2)
    rng = np.random.default_rng(3)
    kept = 3 * PAGE_ROWS - 72
    source = np.concatenate([rng.choice(COUNT, kept, replace=False), rng.choice(COUNT, 2 * PAGE_ROWS - 48)])
    pages.fetch(wanting(1, 4))
    pages.regrow(source.astype(np.uint32), kept, positions[source], "sh_rest")
    assert pages.pages == 5 and not pages.room
    assert np.array_equal(pages.download("sh_rest"), values["sh_rest"][source])
    for name in ("m_rest", "v_rest"):
        found = pages.download(name)
        assert np.array_equal(found[:kept], values[name][source[:kept]]) and not found[kept:].any()
    pages.write("sh_rest", values["sh_rest"][:10] + 1, 50)
    pages.fetch(wanting(0, 1, of=5))
    assert np.array_equal(pages.download("sh_rest")[50:60], values["sh_rest"][:10] + 1)


def test_pages_that_fit_no_memory_are_in_a_file(item_device, monkeypatch, tmp_path):
    """In a folder where nothing is left of it; a full disk is one clear line."""
    monkeypatch.setattr("clsplat.optimise.page_store.host_memory", lambda: 0.0)
    values = values_of(COUNT, 1)
    positions = np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)
    store = PageStore(positions, values, tmp_path)
    pages = Pages(item_device, store, lambda: 20 * store.page_bytes)
    assert all(isinstance(store.memory(name, 0).base, np.memmap) for name in values)
    pages.fetch(wanting(2, 5))
    pages.note_change()
    assert all(np.array_equal(pages.download(name), values[name]) for name in values)
    assert not list(tmp_path.iterdir())

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full, raising=False)
    with pytest.raises(InputError, match="no room for .*No space left"):
        pages.regrow(np.arange(COUNT, dtype=np.uint32), COUNT, positions, "sh_rest")


def test_sums_are_those_of_plain_arrays(float_device, blocks):
    pages, _, values = pages_of(float_device, 2)
    total = pages.download("sh_rest")
    pages.add_to("sh_rest", total)
    assert np.array_equal(total, 2 * values["sh_rest"])


def test_pages_that_are_not_there_take_turns_in_a_few_slots(float_device):
    pages, _, values = pages_of(float_device, 3)
    pages.fetch(wanting(0, 1, 2))
    groups = [group.tolist() for group in pages.rounds(PAGE_ROWS)]
    assert sorted(sum(groups, [])) == list(range(6)) and sum(groups[:3], []) == [0, 1, 2]
    there = np.flatnonzero(pages.slots.download() < PAGE_ABSENT)
    assert len({0, 1, 2} & set(there.tolist())) == 2


def test_slots_are_made_anew_where_there_is_memory_for_many_more(float_device):
    pages, _, values = pages_of(float_device, 3)
    pages.fetch(wanting(0, 1))
    pages.note_change()
    pages._free = lambda: 0
    assert not pages.leave_for_more() and pages.room == 3
    pages._free = lambda: (5 - pages.room) * pages.store.page_bytes
    assert pages.leave_for_more() and not pages.room
    pages.fetch(wanting(0, 1))
    assert pages.room == 5 and not pages.leave_for_more()
    assert all(np.array_equal(pages.download(name), values[name]) for name in values)


def test_pages_that_are_neighbours_travel_together(float_device, monkeypatch, blocks):
    pages, _, values = pages_of(float_device, 6)
    reads, read = [], pages._transfers.read
    monkeypatch.setattr(
        pages._transfers,
        "read",
        lambda array, first, host: (reads.append((first, len(host))), read(array, first, host)),
    )
    pages.fetch(wanting(1, 2, 3, 5))
    pages.note_change()
    assert all(np.array_equal(pages.download(name), values[name]) for name in values)
    if len(pages.store._blocks["sh_rest"]) == 1:
        assert sorted(reads) == 3 * [(0, 3)] + 3 * [(3, 1)]


@pytest.mark.parametrize("share", [0, 1e-3, 0.5, 1])
def test_pages_of_flagged_rows_are_wanted(float_device, share):
    pages, _, _ = pages_of(float_device, 2)
    flags = (np.random.default_rng(4).random(COUNT) < share).astype(np.uint32)
    wanted = pages.mark(float_device.upload(flags)).download()
    assert np.array_equal(wanted > 0, wanted_pages(flags, pages.places.download(), 6, PAGE_ROWS))


def test_the_page_that_is_wanted_last_leaves(float_device):
    pages, _, _ = pages_of(float_device, 3)
    for number in (0, 1, 2):
        pages.fetch(wanting(number))

    def there():
        return set(np.flatnonzero(pages.slots.download() < PAGE_ABSENT))

    assert there() == {0, 1, 2}
    pages.fetch(wanting(3), lambda: np.array([1, 9, 2, 0, 0, 0]))
    assert there() == {0, 2, 3}
    pages.fetch(wanting(4))  # without a forecast the one that was wanted first
    assert there() == {2, 3, 4}


@pytest.mark.oclgrind
def test_a_frame_fails_where_a_page_is_not_there(float_device):
    pages, _, _ = pages_of(float_device, 2)
    pages.fetch(wanting(0, 3))
    places = pages.places.download()

    def fails(page, clears=True, before=0):
        flags = np.zeros(COUNT, np.uint32)
        flags[np.flatnonzero(places // PAGE_ROWS == page)[5]] = 1
        counts = new_counts(float_device)
        counts.write(np.array([before], np.uint32), COUNT_FAILED)
        pages.require(float_device.upload(flags), counts, clears)
        return counts.download()[COUNT_FAILED] == LACKS_PAGE

    assert not fails(3) and fails(5) and not fails(0)
    assert not fails(5, before=1), "an earlier frame lacked room"
    assert fails(1, clears=False) and fails(0)  # a step of two views, of which one lacks a page
    assert not fails(0)


@pytest.mark.parametrize("margin", [0.0, 8.0])
def test_rows_are_flagged_that_are_seen_once_they_have_caught_up(float_device, margin):
    """All that `cull` will see, and not many more; fresh rows and stale ones, and some steps later."""
    run, rng = Lazy(float_device, count=900), np.random.default_rng(5)
    for _ in range(CATCH_UP_EVERY // 4):
        run.step()
    camera = run.camera()
    flags = run.engine.seen(run.rows, camera, run.steps, margin).download() > 0
    culled = cull(float_device, run.current(), camera, DEFINES)[0].download() > 0
    assert flags[culled].all() and culled.sum() > 50
    assert (flags & ~culled).sum() < (1.5 if margin else 0.5) * culled.sum()  # of 60 x 40 pixels
    assert (flags >= (run.engine.seen(run.rows, camera, run.steps, 0.0).download() > 0)).all()
    for ahead in (0.02, 0.0), (0.0, 0.1):  # of steps of the largest size
        flags = run.engine.seen(run.rows, camera, run.steps, margin, ahead).download() > 0
        moved = run.current()
        moved["positions"].write(moved["positions"].download() + rng.choice((-1, 1), (run.count, 3)) * 7.2 * ahead[0])
        moved["log_scales"].write(moved["log_scales"].download() + 7.2 * ahead[1])
        later = cull(float_device, moved, camera, DEFINES)[0].download() > 0
        assert flags[later].all() and (later & ~culled).any()
