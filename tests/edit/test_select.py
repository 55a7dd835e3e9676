import numpy as np
import pytest

from clsplat.edit.select import in_polygons, merged, neighbours, selected
from clsplat.errors import InputError
from tests.data.cloud import cloud

SQUARE = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
HOLE = np.array([[1.0, 1], [1, 3], [3, 3], [3, 1], [1, 1]])  # closed, as GeoJSON has it


def test_polygons():
    points = np.array([[0.5, 0.5], [2, 2], [3.5, 2], [5, 2], [-1, 2], [11, 11], [2, 0.5]])
    one = in_polygons(points, [[SQUARE]])
    assert one.tolist() == [True, True, True, False, False, False, True]
    holed = in_polygons(points, [[SQUARE, HOLE], [SQUARE + 10]])
    assert holed.tolist() == [True, False, True, False, False, True, True]
    assert (in_polygons(points, [[SQUARE[::-1]]]) == one).all(), "either way round"
    tiles = [[SQUARE + (4 * x, 4 * y)] for x in range(3) for y in range(3)]
    grid = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), axis=-1).reshape(-1, 2)
    counts = sum(in_polygons(grid, [tile]).astype(int) for tile in tiles)
    assert (counts == 1).all(), "a border belongs to one side"


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_neighbours_do_not_depend_on_units(unit):
    model = cloud(28)
    grid = np.stack(np.meshgrid(*3 * [np.arange(3.0)]), axis=-1).reshape(-1, 3)
    model.rows["positions"][:27] = unit * grid
    model.rows["positions"][27] = unit * np.array([50.0, 0, 0])
    found = neighbours(model, 20)
    assert found[27] == 0 and (found[:27] == 20).all()
    assert neighbours(selected(model, np.arange(28) == 0), 5).tolist() == [0]


def test_models_are_merged_where_they_stand():
    one, other = cloud(5, 1, offset=(100.0, 0, 0)), cloud(7, 3, seed=1, offset=(103.0, 2, 1))
    both = merged([one, other])
    assert both.count == 12 and both.sh_degree == 3 and (both.offset == one.offset).all()
    world = np.concatenate([model.positions + model.offset for model in (one, other)])
    assert np.allclose(both.positions + both.offset, world, atol=1e-5)
    assert (both.sh_rest[5:] == other.sh_rest).all() and (both.sh_rest[:5, 3:] == 0).all()
    with pytest.raises(InputError, match="too far apart"):
        merged([one, cloud(4, size=1e-3, offset=(5e6, 0, 0))])
