"""Arrays of an .npz: many are read at the same time, and each as it was written."""

import numpy as np

from clsplat.io import npz
from clsplat.io.npz import read_npz, write_npz


def test_many_arrays_are_read_at_the_same_time_as_they_were_written(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    arrays = {f"array {number}": rng.random((3_000 + number, 5)).astype(np.float32)
              for number in range(60)}
    arrays |= {"empty": np.zeros((0, 3)), "number": np.array(7), "columns": np.ones((4, 3)).T}
    with open(tmp_path / "arrays.npz", "wb") as file:
        write_npz(file, arrays)
    opened, plain = [], npz.ZipFile
    monkeypatch.setattr(npz, "ZipFile", lambda path: opened.append(path) or plain(path))
    for _ in range(20):
        found = read_npz(tmp_path / "arrays.npz")
        assert list(found) == list(arrays)
        for name, values in arrays.items():
            assert found[name].dtype == values.dtype and np.array_equal(found[name], values), name
    # threads that share a file read at each other's places, on some versions of Python
    assert len(opened) == 20 * len(arrays)
    assert list(read_npz(tmp_path / "arrays.npz", lambda name: name == "number")) == ["number"]
