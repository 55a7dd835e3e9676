"""Training photos: the same arrays whether they stay on the device or are read ahead of use, each
level read once, while the one before it trains."""

import concurrent.futures
import threading
from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.io.photos.images import read_image, write_image
from clsplat.io.photos.views import photo_bands
from clsplat.scene import View
from clsplat.training import photos as module
from clsplat.training.photos import Photos, begin_checks, begin_photos, decoded, epoch_order
from tests.refusals import refused

WIDTH, HEIGHT = 20, 14


@pytest.fixture
def views(tmp_path):
    """Four views whose photos are twice as wide and high as their cameras' images."""
    camera = Camera(WIDTH, HEIGHT, (20.0, 20.0), (10.0, 7.0), np.eye(3), np.zeros(3))
    rng = np.random.default_rng(0)
    made = []
    for i in range(4):
        path = tmp_path / f"{i}.png"
        write_image(path, rng.integers(0, 256, (2 * HEIGHT, 2 * WIDTH, 3), np.uint8))
        made.append(View(path.name, camera, path))
    return made


@pytest.fixture
def reads(monkeypatch):
    """(name, width) of the photos read so far."""
    found = []

    def noted(view):
        found.append((view.source.name, view.camera.width))
        return photo_bands(view)

    monkeypatch.setattr(module, "photo_bands", noted)
    return found


@pytest.fixture
def no_room(monkeypatch):
    """Neither memory nor disk for photos that wait."""
    monkeypatch.setattr(module, "IN_MEMORY_BYTES", 0)
    monkeypatch.setattr(module, "DISK_SHARE", 0)


def all_at(width):
    return [(f"{i}.png", width) for i in range(4)]


def bytes_at(level):
    return 4 * 3 * (WIDTH // level) * (HEIGHT // level)


def idle(photos):
    """Wait until all is read that was asked before."""
    photos._threads.submit(int).result(timeout=120)
    for store in photos._stores.values():
        store._threads.submit(int).result(timeout=120)
        concurrent.futures.wait(store._shapes, timeout=120)


def is_at(photos, views, level):
    """Whether all photos are those of a level, and their cameras too."""
    size = WIDTH // level, HEIGHT // level
    assert {(v.camera.width, v.camera.height) for v in photos.views} == {size}
    assert photos.level == level
    return all(
        np.array_equal(photos[i].download(), read_image(view.source, size).transpose(2, 0, 1))
        for i, view in enumerate(views)
    )


def test_an_epoch_visits_views_in_proportion():
    """Alike ones once each; others as often as their share says, rounded up or down."""
    assert sorted(epoch_order(3, 0, np.full(7, 0.4))) == list(range(7))
    visits = np.array([1.0, 0.5, 0.25, 0.25, 0.01])
    orders = [epoch_order(3, epoch, visits) for epoch in range(400)]
    counts = np.array([np.bincount(order, minlength=5) for order in orders])
    wanted = 5 * visits / visits.sum()
    assert (np.abs(counts - wanted) < 1).all()
    assert np.allclose(counts.mean(axis=0), wanted, atol=0.05)
    assert len({tuple(order) for order in orders}) > 100
    assert np.array_equal(orders[7], epoch_order(3, 7, visits))


def test_photos_begin_at_the_level_of_a_resumed_run(item_device, views, reads):
    photos = Photos(item_device, views, (4.0, 2.0, 1.0), level=2.0)
    photos.use(2.0)
    assert is_at(photos, views, 2)
    photos.use(1.0)
    assert is_at(photos, views, 1)
    assert sorted(reads) == sorted(all_at(WIDTH // 2) + all_at(WIDTH))
    photos.close()


def test_the_budget_is_that_of_the_images_trained_on(item_device, views):
    for level in (1, 2):
        size = bytes_at(level)
        assert Photos(item_device, views, (level,), size).resident
        assert not Photos(item_device, views, (level,), size - 1).resident


@pytest.mark.parametrize("levels", [(1.0,), (2.0, 1.0)])
@pytest.mark.parametrize("budget", [None, 0])
def test_a_damaged_photo_is_refused_at_the_start(item_device, views, levels, budget):
    data = views[3].source.read_bytes()
    views[3].source.write_bytes(data[: len(data) * 2 // 3])
    refused(lambda: Photos(item_device, views, levels, budget), "3.png", "damaged or cut short")
    refused(lambda: list(decoded(views)), "3.png")
    refused(begin_checks(views).wait, "3.png")
    begun = begin_photos(item_device, views, levels[0], views[3].source.parent)
    refused(lambda: Photos(item_device, views, levels, budget, begun=(levels[0], begun)), "3.png")


def test_twelve_photos_of_50_megapixels_leave_room_in_host_memory(views, monkeypatch):
    """Less than 1.5 GiB by far, for as many threads as there may be; `plan` says so."""
    monkeypatch.setattr(module, "THREADS", module.MOST_THREADS)
    large = [replace(view, camera=view.camera.resized(8160, 6144)) for view in views]
    assert module.reading_bytes(3 * large) == module.reading_bytes(large[:1]) < 1 << 30
    window = [replace(view, camera=view.camera.cropped(0, 0, 2048, 2048)) for view in large]
    assert module.reading_bytes(window) < module.reading_bytes(large)


def test_each_level_is_read_once_and_ahead_of_its_use(item_device, views, reads):
    photos = Photos(item_device, views, (4.0, 2.0, 1.0))
    for level, following in ((4, 2), (2, 1), (1, None)):
        photos.use(level)
        idle(photos)
        ahead = all_at(WIDTH // following) if following else []
        assert sorted(reads) == sorted((all_at(WIDTH // 4) if level == 4 else []) + ahead)
        reads.clear()
        assert photos.resident and is_at(photos, views, level)
        photos.use(level)
        photos.expect(0)
        assert not reads
    photos.close()


@pytest.mark.parametrize("share, in_memory, kept", [(0.25, 4, 4), (0.25, 2, 2), (0, 2, 4)])
def test_photos_that_were_begun_are_not_read_again(
    item_device, views, reads, monkeypatch, tmp_path, share, in_memory, kept
):
    """Those that will stay on the device wait in memory, as many as may; others also in a file."""
    monkeypatch.setattr(module, "DEVICE_SHARE", share)
    monkeypatch.setattr(module, "IN_MEMORY_BYTES", in_memory * bytes_at(2) // 4)
    begun = begin_photos(item_device, views, 2.0, tmp_path)
    begun.wait()
    assert begun.count == kept and sorted(reads) == all_at(WIDTH // 2)[:kept]
    photos = Photos(item_device, views, (4.0, 2.0, 1.0), level=2.0, begun=(2.0, begun))
    idle(photos)
    assert sorted(reads) == sorted(all_at(WIDTH // 2) + all_at(WIDTH))
    assert photos.resident is bool(share) and is_at(photos, views, 2)
    photos.close()


def test_a_level_trains_while_the_next_is_read(item_device, views, monkeypatch):
    """Its photos are there though no photo of the next level can be read yet."""
    may_read, readers = threading.Event(), set()

    def held(view):
        if view.camera.width == WIDTH:
            readers.add(threading.get_ident())
            assert may_read.wait(120)
        return photo_bands(view)

    monkeypatch.setattr(module, "photo_bands", held)
    photos = Photos(item_device, views, (2.0, 1.0))
    assert is_at(photos, views, 2)
    may_read.set()
    photos.use(1.0)
    assert is_at(photos, views, 1)
    assert len(readers) == 1 and threading.get_ident() not in readers
    photos.close()


@pytest.mark.parametrize(
    "budget, resident", [(bytes_at(2), True), (bytes_at(1) - 1, True), (bytes_at(2) - 1, False), (0, False)]
)
def test_a_level_beyond_the_budget_is_streamed(item_device, views, reads, budget, resident):
    photos = Photos(item_device, views, (2.0, 1.0), budget)
    idle(photos)
    assert sorted(reads) == sorted(all_at(WIDTH // 2) + all_at(WIDTH))  # once each
    assert photos.resident is resident and is_at(photos, views, 2)
    photos.expect(1)
    idle(photos)
    photos.use(1.0)
    assert not photos.resident and is_at(photos, views, 1)
    assert len(reads) == 8
    photos.close()


def test_photos_without_a_place_are_decoded_at_each_use(item_device, views, reads, no_room):
    photos = Photos(item_device, views, (2.0, 1.0), 0)
    idle(photos)
    assert sorted(reads) == all_at(WIDTH // 2)  # all of them once, for damage
    assert is_at(photos, views, 2)
    photos.use(1.0)
    idle(photos)
    reads.clear()
    assert is_at(photos, views, 1) and sorted(reads) == all_at(WIDTH)
    photos.expect(1)  # of this level, whatever was expected before
    idle(photos)
    assert reads[4:] == [("1.png", WIDTH)]
    assert photos[1].shape == (3, HEIGHT, WIDTH)
    assert len(reads) == 5
    photos.close()
