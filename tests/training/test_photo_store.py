"""Photos that wait on the host are the same from memory, from the file and decoded again."""

import errno
import io
import os
import tempfile

import numpy as np
import pytest

from clsplat.training import photos as module
from clsplat.training.photos import PhotoStore

PHOTOS = [np.random.default_rng(i).integers(0, 256, (3 + (i == 2), 5 + i, 7), np.uint8) for i in range(6)]
SIZES = [photo.nbytes + 9 for photo in PHOTOS]  # of which masks may turn out to be none


@pytest.fixture(autouse=True)
def no_memory(monkeypatch):
    """Photos wait in a file."""
    monkeypatch.setattr(module, "IN_MEMORY_BYTES", 0)


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


def test_few_photos_wait_in_memory(decodes, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "IN_MEMORY_BYTES", sum(SIZES))
    store = store_of(decodes, tmp_path / "gone")  # where no file could be
    store.wait()
    assert store.count == 6 and is_whole(store) and sorted(decodes) == [*range(6)]
    store.close()


def test_photos_wait_in_a_file_without_a_name(decodes, tmp_path):
    store = store_of(decodes, tmp_path)
    store.wait()
    if os.name == "posix":
        assert not any(tmp_path.iterdir())  # a process that is killed leaves nothing
    assert store.count == 6 and is_whole(store) and sorted(decodes) == [*range(6)]
    store.close()
    assert not any(tmp_path.iterdir())


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
