"""Arrays from an .npz: some of their rows, and damage in those that are left out."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io import npz
from clsplat.io.npz import read_npz, write_npz

ARRAYS = {"wide": np.arange(3000, dtype=np.float32).reshape(50, 4, 15),
          "flat": np.arange(50, dtype=np.uint32)}


@pytest.fixture
def path(tmp_path):
    with open(tmp_path / "arrays.npz", "wb") as file:
        write_npz(file, ARRAYS)
    return tmp_path / "arrays.npz"


@pytest.mark.parametrize("chunk", [1, 300, 1 << 21])  # bytes; a row of the wide array has 240
@pytest.mark.parametrize("rows", [[], [0], [49], [0, 1, 24, 25, 49], range(50)])
def test_some_rows_are_those_of_the_whole_array(path, monkeypatch, chunk, rows):
    monkeypatch.setattr(npz, "CHUNK", chunk)
    rows = np.array(rows, np.int64)
    found = read_npz(path, "damaged", "copy it again", rows=rows)
    assert set(found) == set(ARRAYS)
    for name, values in ARRAYS.items():
        assert found[name].dtype == values.dtype and np.array_equal(found[name], values[rows])


def test_damage_in_rows_that_are_left_out_is_found(path):
    content = bytearray(path.read_bytes())
    content[content.index(ARRAYS["wide"][30].tobytes())] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"damaged \(.*wide.*\); copy it again"):
        read_npz(path, "damaged", "copy it again", rows=np.array([2, 3]))


def test_rows_that_there_are_not(path):
    with pytest.raises(InputError, match="out of bounds"):
        read_npz(path, "damaged", "copy it again", rows=np.array([2, 50]))
