import numpy as np
import pytest

from clsplat.edit.select import merged
from clsplat.errors import InputError
from tests.data.cloud import cloud


def test_models_are_merged_where_they_stand():
    one, other = cloud(5, 1, offset=(100.0, 0, 0)), cloud(7, 3, seed=1, offset=(103.0, 2, 1))
    both = merged([one, other])
    assert both.count == 12 and both.sh_degree == 3 and (both.offset == one.offset).all()
    world = np.concatenate([model.positions + model.offset for model in (one, other)])
    assert np.allclose(both.positions + both.offset, world, atol=1e-5)
    assert (both.sh_rest[5:] == other.sh_rest).all() and (both.sh_rest[:5, 3:] == 0).all()
    with pytest.raises(InputError, match="too far apart"):
        merged([one, cloud(4, size=1e-3, offset=(5e6, 0, 0))])
