"""Training photos: the same arrays whether they stay on the device or are read ahead of use."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.images import read_image, write_image
from clsplat.scene import View
from clsplat.train import photos as module
from clsplat.train.photos import Photos, decoded

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
    """The names of the photos read so far."""
    names = []

    def noted(source, size):
        names.append(source.name)
        return read_image(source, size)

    monkeypatch.setattr(module, "read_image", noted)
    return names


def test_resident_and_streaming_give_the_same_planes(float_device, views):
    resident, streaming = Photos(float_device, views), Photos(float_device, views, budget_bytes=10)
    assert resident.resident and not streaming.resident
    for i in (2, 0, 2, 3, 1):
        expected = read_image(views[i].source, (WIDTH, HEIGHT)).transpose(2, 0, 1)
        for photos in (resident, streaming):
            photo = photos[i]
            assert (photo.shape, photo.dtype) == ((3, HEIGHT, WIDTH), np.uint8)
            assert np.array_equal(photo.download(), expected)
    resident.close()
    streaming.close()


def test_the_budget_is_that_of_the_images_trained_on(float_device, views):
    size = 4 * 3 * WIDTH * HEIGHT
    assert Photos(float_device, views, size).resident
    assert not Photos(float_device, views, size - 1).resident


def test_resident_photos_are_decoded_once(float_device, views, reads):
    photos = Photos(float_device, views)
    for i in (0, 1, 0, 3):
        photos.expect(i)
        photos[i]
    assert sorted(reads) == ["0.png", "1.png", "2.png", "3.png"]


def test_what_is_expected_is_read_ahead_once(float_device, views, reads):
    photos = Photos(float_device, views, budget_bytes=0)
    photos.expect(2)
    photos.expect(2)
    photos._thread.submit(int).result()  # one thread: what was asked before is done
    assert reads == ["2.png"]
    photos[2]
    assert reads == ["2.png"]
    photos[2]
    assert reads == ["2.png", "2.png"]
    photos.close()


def test_a_damaged_photo_is_refused_at_the_start(float_device, views):
    data = views[3].source.read_bytes()
    views[3].source.write_bytes(data[:len(data) * 2 // 3])
    with pytest.raises(InputError, match="3.png.*damaged or cut short"):
        Photos(float_device, views)
    with pytest.raises(InputError, match="3.png"):
        list(decoded(views))


def test_a_damaged_photo_read_ahead_is_reported_where_it_is_used(float_device, views):
    photos = Photos(float_device, views, budget_bytes=0)
    views[1].source.unlink()
    photos.expect(1)
    with pytest.raises(InputError, match="1.png"):
        photos[1]
    photos.close()
