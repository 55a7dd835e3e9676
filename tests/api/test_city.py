"""`clsplat.city`: the same as the command."""

import pytest

import clsplat
from tests.data.tiny_training import CITY


@pytest.mark.slow
def test_a_city_is_a_run_that_goes_on(item_device, tmp_path):
    options = clsplat.TrainOptions(iterations=40, downscale=8, sh_degree=0, init="sfm")
    partition = {"grid": (2, 1), "joint_steps": "none", "exchanges": 0}
    run = clsplat.city(CITY, options, output=tmp_path / "city", partition=partition, workers=1)
    assert run.is_finished and run.model.count > 1000 and len(run.metrics) >= 1
    again = clsplat.city(CITY, options, output=tmp_path / "city", partition=partition, workers=1)
    assert again.model.count == run.model.count
    with pytest.raises(clsplat.ClsplatError, match="partition: unknown option 'gird'"):
        clsplat.city(CITY, options, partition={"gird": (2, 1)})
    with pytest.raises(clsplat.ClsplatError, match="--init"):
        clsplat.city(CITY, clsplat.TrainOptions(init="random"), output=tmp_path / "other")
