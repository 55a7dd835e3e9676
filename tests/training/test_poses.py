"""Trainings that correct the poses of their views: what they recover, record and refuse."""

import numpy as np
import pytest

from clsplat.cities.city import City
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import read_poses
from clsplat.optimise.pose import WARM_UP
from clsplat.options import resolve
from clsplat.placement.corrections import Correction, correction_between, typical_depth, without_common_motion
from tests.data.tiny_training import STILL, options_of, trained

FOCAL = 69.3  # pixels, of the city at a quarter of its size
OPTIONS = {"poses": "on", "downscale": 4.0, "exposure": "off", **STILL}


@pytest.mark.slow
def test_disturbed_poses_are_recovered(item_device, city, tmp_path):
    """By a third at least, without the motion that all have in common, which no photo tells."""
    rng, depth = np.random.default_rng(0), typical_depth([v.camera for v in city.views], city.points)
    wrong = {view.name: Correction(rng.normal(0, 0.005, 3), depth * rng.normal(0, 0.002, 3)) for view in city.views}
    run = trained(tmp_path / "run", city.corrected(wrong), item_device, iterations=700, **OPTIONS)
    learned = read_poses(run.path)
    train, test = city.split(8)
    assert set(learned) == {view.name for view in train}

    def pixels_off(cameras):
        true = [view.camera for view in train]
        off = without_common_motion(true, list(map(correction_between, true, cameras)), depth)
        return np.mean([np.hypot(c.turn[1] - c.shift[0] / depth, c.turn[0] + c.shift[1] / depth) for c in off]) * FOCAL

    given = [wrong[view.name].applied(view.camera) for view in train]
    assert 0.3 < pixels_off(given) < 0.8
    corrected = [learned[view.name].applied(camera) for view, camera in zip(train, given)]
    assert pixels_off(corrected) < 0.7 * pixels_off(given)


@pytest.mark.slow
def test_poses_stay_in_the_warm_up_and_are_recorded(item_device, city, tmp_path):
    few = round(WARM_UP * 100)
    run = trained(tmp_path / "run", city, item_device, **OPTIONS, iterations=100, stop_at=few)
    moments = [run.load_checkpoint()[0][f"pose.{name}"] for name in ("poses", "m", "v", "steps")]
    assert all(array.shape[0] == 28 and not array.any() for array in moments)
    other = trained(tmp_path / "other", city, item_device, **OPTIONS, iterations=3)
    moved = read_poses(other.path)
    assert len(moved) == 28 and sum(each.turn.any() for each in moved.values()) == 2  # 1 is warm-up
    shown = {view.name: view.camera for view in Run.open(other.path).scene().views}
    given = {view.name: view.camera for view in city.reduced(4).views}
    assert {name for name, camera in shown.items() if not np.array_equal(camera.rotation, given[name].rotation)} == {
        name for name, each in moved.items() if each.turn.any()
    }


def test_cities_and_the_reprojection_loss_refuse_it(city, tmp_path):
    with pytest.raises(InputError, match="^--poses on: is for single runs; the blocks of a city"):
        City(CityFolder(tmp_path), city, options_of(poses="on"), None).begin()
    with pytest.raises(InputError, match="^--poses on: does not go with --reproject, which"):
        resolve({}, {"poses": "on", "reproject": "auto"})
