"""A run and its model know where they lie and which way is up, also after a stop."""

from dataclasses import replace

import pytest

from clsplat.errors import Interrupted
from clsplat.evaluation.run import Run
from clsplat.georeference import Georeference
from clsplat.io.models.ply import read_vertices
from clsplat.io.runs.run import RunFolder
from clsplat.options import resolve
from clsplat.training import run as trainings
from tests.data.tiny_training import STILL


@pytest.mark.slow
def test_the_run_and_its_model_know_where_they_lie(item_device, city, tmp_path):
    here = Georeference("EPSG:32614", (5e5, 3e6, 300.0), "test", 0.5)
    scene = replace(city, georeference=here).with_up([0.0, 0.0, 2.0])
    options = resolve({}, {**STILL, "iterations": 20})
    with pytest.raises(Interrupted):
        trainings.train(scene, replace(options, stop_at=10), item_device, RunFolder.create(tmp_path / "stopped"))
    trainings.resumed(city, options, item_device, RunFolder.open(tmp_path / "stopped")).take()
    trainings.train(scene, options, item_device, RunFolder.create(tmp_path / "whole"))
    stopped, whole = (Run.open(tmp_path / name) for name in ("stopped", "whole"))
    assert stopped.folder.model_path.read_bytes() == whole.folder.model_path.read_bytes()
    assert whole.georeference == here and whole.up.tolist() == [0, 0, 1]
    comments = read_vertices(whole.folder.model_path)[1]
    assert {"up 0 0 1", "Vertical Axis: z", "crs EPSG:32614"} <= set(comments)
