"""A model that is taken back goes on as if nothing had followed it."""

import numpy as np
import pytest

from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.optimise.numpy_adam import NumpyAdam
from clsplat.training.budget import Rollback
from clsplat.training.loop import Training
from tests.data.tiny_training import CITY, options_of

OPTIONS = {"iterations": 40, "densify_from": 1, "densify_every": 5, "sh_degree": 1, "sh_every": 1}


@pytest.fixture
def training(item_device, tmp_path, request):
    """A training after 8 steps, one of which the model has grown after."""
    made = Training(read_scene(CITY), options_of(**OPTIONS, engine=request.param), item_device,
                    RunFolder.create(tmp_path / "run"))
    made.clock.restart()
    for _ in range(8):
        made.take_step()
    yield made
    made.session.photos.close()


def state_of(model):
    m, v = model.adam.download()
    return [model.download(stored=True).rows, m, v]


def spoil(step):
    """Move the gaussians to where no view sees them."""
    positions = step.model.rows["positions"]
    positions.write(positions.download() + 1000)


@pytest.mark.parametrize("training", ["device", "numpy"], indirect=True)
@pytest.mark.parametrize("grows", [True, False])
@pytest.mark.one_in(3)
def test_rows_and_moments_are_those_of_the_copy(training, grows):
    session, step = training.session, training.session.step
    kept, before = Rollback(step, session.iteration), state_of(step.model)
    for _ in range(4 if grows else 1):
        training.take_step()
    assert (step.count > len(before[0]["positions"])) is grows
    spoil(step)
    assert kept.restore_if_better(step, session.scoring_views()[:2])
    for found, expected in zip(state_of(step.model), before):
        assert found.keys() == expected.keys()
        assert all(np.array_equal(found[name], expected[name]) for name in expected)
    # a run that is killed before its model is written resumes from here, with either engine
    lag = step.model.adam.lag()
    assert (lag["last_step"] == session.iteration).all() and lag["is_current"].all()
    NumpyAdam(step.device, step.model.rows, dense=True).load_lag(lag, session.iteration)
    for _ in range(6):  # and may grow
        training.take_step()
    assert np.isfinite(step.model.download().rows["positions"]).all()


@pytest.mark.parametrize("training", ["device"], indirect=True)
def test_the_present_model_stays_where_it_is_better(training):
    session, step = training.session, training.session.step
    right = step.model.download()
    spoil(step)
    kept = Rollback(step, session.iteration)
    step.model.adopt(right)
    before, adam = state_of(step.model), step.model.adam
    assert not kept.restore_if_better(step, session.scoring_views()[:2])
    assert step.model.adam is adam
    for found, expected in zip(state_of(step.model), before):
        assert all(np.array_equal(found[name], expected[name]) for name in expected)
