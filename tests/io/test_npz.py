"""Arrays of an .npz: each is read as it was written, and the file is as numpy's own."""

import io
import threading
import zipfile

import numpy as np
import pytest

from clsplat.io import npz
from clsplat.io.npz import read_npz, read_rows, write_npz


def some_arrays(count):
    rng = np.random.default_rng(0)
    arrays = {f"array {number}": rng.random((3_000 + number, 5)).astype(np.float32) for number in range(count)}
    return arrays | {
        "empty": np.zeros((0, 3)),
        "number": np.array(7),
        "text": np.array("four"),
        "columns": np.arange(12.0).reshape(4, 3).T,
        "some": np.arange(9)[::2],
    }


def test_many_arrays_are_read_at_the_same_time_as_they_were_written(tmp_path, monkeypatch):
    arrays, threads, read = some_arrays(60), set(), npz._read_array
    with open(tmp_path / "arrays.npz", "wb") as file:
        write_npz(file, arrays)
    monkeypatch.setattr(npz, "_read_array", lambda *args: threads.add(threading.get_ident()) or read(*args))
    monkeypatch.setattr(npz, "PART_BYTES", 1 << 12)
    for _ in range(20):
        found = read_npz(tmp_path / "arrays.npz")
        assert list(found) == list(arrays)
        for name, values in arrays.items():
            assert found[name].dtype == values.dtype and found[name].shape == values.shape
            assert np.array_equal(found[name], values), name
    assert len(threads) > 1
    assert list(read_npz(tmp_path / "arrays.npz", lambda name: name == "number")) == ["number"]


def test_the_file_is_what_numpy_writes(monkeypatch):
    monkeypatch.setattr(npz, "PART_BYTES", 1 << 12)
    ours, theirs = io.BytesIO(), io.BytesIO()
    write_npz(ours, some_arrays(3))
    np.savez(theirs, **{name: np.asarray(values, order="C") for name, values in some_arrays(3).items()})
    assert ours.getvalue() == theirs.getvalue()


def test_a_compressed_or_damaged_array_is_refused(tmp_path):
    path, arrays = tmp_path / "arrays.npz", some_arrays(1)
    np.savez_compressed(path, **arrays)
    with pytest.raises(ValueError, match="compressed"):
        read_npz(path)
    np.savez(path, **arrays)
    content = bytearray(path.read_bytes())
    content[content.index(arrays["array 0"].tobytes()) + 59_999] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match="CRC of array 0.npy"):
        read_npz(path)


def test_some_rows_are_those_of_the_whole_wherever_an_array_begins(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "arrays.npz"
    arrays = {"a" * length: rng.random((500, 7)).astype(np.float32) for length in range(1, 6)}
    arrays |= {"deep": rng.random((500, 3, 5)), "one": np.arange(500, dtype=np.uint32)}
    with open(path, "wb") as file:
        write_npz(file, arrays)
    for rows in (np.arange(0, 500, 3), np.array([], int), np.array([499])):
        found = read_rows(path, lambda name: name != "aa", rows)
        assert set(found) == set(arrays) - {"aa"}
        for name, values in found.items():
            assert values.dtype == arrays[name].dtype
            assert np.array_equal(values, arrays[name][rows]), name
    with pytest.raises(IndexError):
        read_rows(path, lambda name: name == "one", np.array([500]))
    path.write_bytes(path.read_bytes()[:-9_000])
    with pytest.raises(zipfile.BadZipFile):
        read_rows(path, lambda name: True, np.array([0]))
    np.savez(path, columns=np.asfortranarray(arrays["deep"]))
    with pytest.raises(ValueError, match="columns.npy is stored by columns"):
        read_rows(path, lambda name: True, np.array([0]))
