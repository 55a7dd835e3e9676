"""The finished gaussians are the mean of those of the last steps."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.gaussians import LEARNED
from clsplat.io.scenes.read import read_scene
from clsplat.training.model import Model
from clsplat.training.parts.average import LEAST_EVERY, Average
from tests.data.tiny_training import CITY, model_digest, resumed, trained
from tests.training.test_model import gaussians_of

TINY = {
    "schedule": "sig",
    "init": "sfm",
    "levels": (1.0,),
    "iterations": 4 * LEAST_EVERY + 20,
    "average": 0.5,
    "downscale": 8.0,
    "eval_every": 0,
    "exposure": "off",
}


def session_of(device, iterations=1000, share=0.3):
    """What the part needs of a session, with six gaussians."""
    model = Model(device, gaussians_of(6))
    return SimpleNamespace(
        model=model, iteration=0, device=device, options=SimpleNamespace(iterations=iterations, average=share)
    )


def advance(session, part, value):
    """Set all fields to a value, where the part may take its sample."""
    for field in LEARNED:
        row = session.model.rows[field.name]
        row.write(np.full(row.shape, value, np.float32))
    part.before_step(session, None)


def test_the_mean_of_the_last_samples(item_device):
    """Of 1000 steps and a share of 0.3 those after 750, 800, ... 950 and the last one count."""
    session, part = session_of(item_device), Average()
    for session.iteration in range(1000):
        advance(session, part, session.iteration)
    assert part._samples == 5
    part.finish(session)
    for field in LEARNED:
        values = session.model.rows[field.name].download()
        assert np.allclose(values, np.mean([750, 800, 850, 900, 950, 999])), field.name
    assert not part.state(), "a finished run that is resumed keeps its mean"


def test_other_gaussians_begin_another_mean_and_frozen_gaussians_stay(item_device):
    session, part = session_of(item_device), Average()
    session.iteration = 800
    advance(session, part, 800.0)
    assert part._samples == 1
    part.rows_changed(session.model, None)  # they have moved
    assert part._samples == 1
    session.model = Model(item_device, gaussians_of(4))
    part.rows_changed(session.model, SimpleNamespace())
    advance(session, part, 2.0)
    session.model.frozen = item_device.upload(np.array([0, 1, 0, 1], np.uint32))
    row = session.model.rows["opacity_logits"]
    row.write(np.full(4, 4.0, np.float32))
    part.finish(session)
    assert row.download().tolist() == [3.0, 4.0, 3.0, 4.0]


@pytest.mark.slow
def test_a_training_resumed_among_its_samples_ends_in_the_same_bytes(item_device, tmp_path):
    scene = read_scene(CITY)
    whole = trained(tmp_path / "whole", scene, item_device, **TINY)
    stopped = trained(tmp_path / "stopped", scene, item_device, **TINY, stop_at=3 * LEAST_EVERY + 7)
    assert model_digest(resumed(stopped, scene, item_device, **TINY)) == model_digest(whole)
    other = trained(tmp_path / "other", scene, item_device, **{**TINY, "average": 0.1})
    assert model_digest(other) != model_digest(whole)
