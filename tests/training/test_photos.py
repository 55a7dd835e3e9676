"""Training photos: the same arrays whether they stay on the device or are read ahead of use, each
level read once, while the one before it trains."""

import threading

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.images import read_image, write_image
from clsplat.io.views import read_photo
from clsplat.scene import View
from clsplat.training import photos as module
from clsplat.training.photos import Photos, decoded

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
        return read_photo(view)

    monkeypatch.setattr(module, "read_photo", noted)
    return found


def all_at(width):
    return [(f"{i}.png", width) for i in range(4)]


def bytes_at(level):
    return 4 * 3 * (WIDTH // level) * (HEIGHT // level)


def idle(photos):
    """Wait until the one thread has done what was asked before."""
    photos._threads.submit(int).result(timeout=120)


def is_at(photos, views, level):
    """Whether all photos are those of a level, and their cameras too."""
    size = WIDTH // level, HEIGHT // level
    assert {(v.camera.width, v.camera.height) for v in photos.views} == {size}
    assert photos.level == level
    return all(np.array_equal(photos[i].download(),
                              read_image(view.source, size).transpose(2, 0, 1))
               for i, view in enumerate(views))


def test_resident_and_streaming_give_the_same_planes(item_device, views):
    resident, streaming = Photos(item_device, views), Photos(item_device, views, budget_bytes=10)
    assert resident.resident and not streaming.resident
    for i in (2, 0, 2, 3, 1):
        expected = read_image(views[i].source, (WIDTH, HEIGHT)).transpose(2, 0, 1)
        for photos in (resident, streaming):
            photo = photos[i]
            assert (photo.shape, photo.dtype) == ((3, HEIGHT, WIDTH), np.uint8)
            assert np.array_equal(photo.download(), expected)
    resident.close()
    streaming.close()


def test_the_budget_is_that_of_the_images_trained_on(item_device, views):
    for level in (1, 2):
        size = bytes_at(level)
        assert Photos(item_device, views, (level,), size).resident
        assert not Photos(item_device, views, (level,), size - 1).resident


def test_the_budget_is_a_quarter_of_the_device_unless_told(item_device, views, monkeypatch):
    assert Photos(item_device, views)._budget == 0.25 * item_device.handle.global_mem_size
    monkeypatch.setattr(module, "DEVICE_SHARE", 0)
    assert not Photos(item_device, views).resident


def test_resident_photos_are_decoded_once(item_device, views, reads):
    photos = Photos(item_device, views)
    for i in (0, 1, 0, 3):
        photos.expect(i)
        photos[i]
    assert sorted(reads) == all_at(WIDTH)


def test_what_is_expected_is_read_ahead_once(item_device, views, reads):
    photos = Photos(item_device, views, budget_bytes=0)
    assert sorted(reads) == all_at(WIDTH)  # at the start, for damage
    reads.clear()
    photos.expect(2)
    photos.expect(2)
    idle(photos)
    assert reads == [("2.png", WIDTH)]
    photos[2]
    assert reads == [("2.png", WIDTH)]
    photos[2]
    assert reads == [("2.png", WIDTH)] * 2
    photos.close()


@pytest.mark.parametrize("levels", [(1.0,), (2.0, 1.0)])
@pytest.mark.parametrize("budget", [None, 0])
def test_a_damaged_photo_is_refused_at_the_start(item_device, views, levels, budget):
    data = views[3].source.read_bytes()
    views[3].source.write_bytes(data[:len(data) * 2 // 3])
    with pytest.raises(InputError, match="3.png.*damaged or cut short"):
        Photos(item_device, views, levels, budget)
    with pytest.raises(InputError, match="3.png"):
        list(decoded(views))


def test_a_damaged_photo_read_ahead_is_reported_where_it_is_used(item_device, views):
    photos = Photos(item_device, views, budget_bytes=0)
    views[1].source.unlink()
    photos.expect(1)
    with pytest.raises(InputError, match="1.png"):
        photos[1]
    photos.close()


# --- levels


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


def test_a_level_trains_while_the_next_is_read(item_device, views, monkeypatch):
    """Its photos are there though no photo of the next level can be read yet."""
    may_read, readers = threading.Event(), set()

    def held(view):
        if view.camera.width == WIDTH:
            readers.add(threading.get_ident())
            assert may_read.wait(120)
        return read_photo(view)

    monkeypatch.setattr(module, "read_photo", held)
    photos = Photos(item_device, views, (2.0, 1.0))
    assert is_at(photos, views, 2)
    may_read.set()
    photos.use(1.0)
    assert is_at(photos, views, 1)
    assert len(readers) == 1 and threading.get_ident() not in readers
    photos.close()


@pytest.mark.parametrize("budget, resident", [
    (bytes_at(2), True), (bytes_at(1) - 1, True), (bytes_at(2) - 1, False), (0, False)])
def test_a_level_beyond_the_budget_is_streamed(item_device, views, reads, budget, resident):
    photos = Photos(item_device, views, (2.0, 1.0), budget)
    idle(photos)
    start = all_at(WIDTH // 2) if resident else all_at(WIDTH)  # all of them once, for damage
    assert sorted(reads) == start  # nothing of the next level
    assert photos.resident is resident and is_at(photos, views, 2)
    photos.expect(1)
    photos.use(1.0)
    idle(photos)
    reads.clear()
    assert not photos.resident and is_at(photos, views, 1)
    assert sorted(reads) == all_at(WIDTH)
    photos.expect(1)  # of this level, whatever was expected before
    idle(photos)
    assert reads[4:] == [("1.png", WIDTH)]
    assert photos[1].shape == (3, HEIGHT, WIDTH)
    assert len(reads) == 5
    photos.close()


def test_levels_may_be_left_out(item_device, views):
    """As a resumed run does, which begins where it was."""
    photos = Photos(item_device, views, (4.0, 2.0, 1.0))
    photos.use(1.0)
    assert is_at(photos, views, 1)
    photos.close()


def test_a_photo_that_is_gone_when_its_level_comes_is_named(item_device, views, monkeypatch):
    gone = []

    def sometimes(view):
        if view.camera.width == WIDTH and view.source.name == "2.png":
            gone.append(view.source)
            raise InputError(f"{view.source}: no such file")
        return read_photo(view)

    monkeypatch.setattr(module, "read_photo", sometimes)
    photos = Photos(item_device, views, (2.0, 1.0))
    idle(photos)
    assert gone and is_at(photos, views, 2)  # it is no error before it is needed
    with pytest.raises(InputError, match="2.png: no such file"):
        photos.use(1.0)
    photos.close()
