"""Photos that wait on the host are the same from the file and decoded again."""

import errno
import io
import os
import tempfile

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.training import photos as photo_files
from clsplat.training.photos import PhotoStore

PHOTOS = [np.random.default_rng(i).integers(0, 256, (3 + (i == 2), 5 + i, 7), np.uint8)
          for i in range(6)]
SIZES = [photo.nbytes + 9 for photo in PHOTOS]  # of which masks may turn out to be none


@pytest.fixture
def decodes():
    """Indices of the photos decoded so far."""
    return []


def store_of(decodes, folder, threads=2):
    def decode(index):
        decodes.append(index)
        return PHOTOS[index]

    return PhotoStore(SIZES, decode, threads, folder)


def is_whole(store):
    return all(np.array_equal(store.read(i), PHOTOS[i]) for i in (0, 5, 3, 1, 2, 4, 3))


def test_photos_wait_in_a_file_without_a_name(decodes, tmp_path):
    store = store_of(decodes, tmp_path)
    store.wait()
    if os.name == "posix":
        assert not any(tmp_path.iterdir())  # a process that is killed leaves nothing
    assert store.count == 6 and is_whole(store) and sorted(decodes) == [*range(6)]
    store.close()
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("kept", [0, 4])
def test_what_has_no_place_is_decoded_at_each_use(decodes, tmp_path, monkeypatch, kept):
    free = type("Usage", (), {"free": 4 * sum(SIZES[:kept])})
    monkeypatch.setattr(photo_files.shutil, "disk_usage", lambda folder: free)
    store = store_of(decodes, tmp_path)
    store.wait()
    assert store.count == kept and sorted(decodes) == [*range(kept)]
    decodes.clear()
    assert is_whole(store) and sorted(decodes) == [i for i in (0, 1, 2, 3, 3, 4, 5) if i >= kept]
    store.close()


def test_a_disk_that_is_full_or_cannot_be_written_does_no_harm(decodes, tmp_path, monkeypatch):
    gone = store_of(decodes, tmp_path / "gone")
    assert gone.count == 0 and is_whole(gone)
    gone.close()

    class Full(io.BytesIO):
        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", lambda dir: Full())
    full = store_of(decodes, tmp_path)
    full.wait()
    assert full.count == 6 and is_whole(full)
    full.close()


def test_errors_appear_where_the_photo_is_read(tmp_path):
    def decode(index):
        if index:
            raise InputError("a.jpg: damaged")
        return PHOTOS[0]

    store = PhotoStore(SIZES[:2], decode, 1, tmp_path)
    assert np.array_equal(store.read(0), PHOTOS[0])
    for failing in (store.wait, lambda: store.read(1)):
        with pytest.raises(InputError, match="a.jpg"):
            failing()
    store.close()
