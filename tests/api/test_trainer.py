"""`clsplat.Trainer`: the steps of a training one by one, with parts and schedules of others."""

import sys
from dataclasses import replace

import numpy as np
import pytest

import clsplat
from tests.api.test_api import EXAMPLES
from tests.data.tiny_training import CITY, model_digest

TINY = clsplat.TrainOptions(
    iterations=6, downscale=8, sh_degree=0, exposure="off", init="sfm", schedule="constant", checkpoint_every="end"
)


@pytest.fixture(scope="module")
def scene():
    return clsplat.Scene.read(CITY)


@pytest.fixture(scope="module")
def whole(scene, item_device, tmp_path_factory):
    """A run by `train`, and the losses that a callback saw. Not to be changed."""
    losses = []
    run = clsplat.train(
        scene,
        TINY,
        output=tmp_path_factory.mktemp("whole") / "run",
        device=item_device,
        callbacks=[lambda record: losses.append(record.get("loss")) if record["event"] == "step" else None],
    )
    return run, losses


def test_a_loop_that_is_left_and_entered_again_ends_in_the_bytes_of_train(whole, scene, item_device, tmp_path):
    trainer, losses = clsplat.Trainer(scene, TINY, output=tmp_path / "run", device=item_device), []
    for step in trainer:
        losses.append(step.loss)
        if step.iteration == 3:
            break
    assert not trainer.run.is_finished and "step 3 of 6" in repr(trainer)
    losses += [step.loss for step in trainer]
    run, expected = whole
    assert losses == expected and list(trainer) == []
    assert trainer.run.is_finished and model_digest(trainer.run) == model_digest(run)
    with pytest.raises(clsplat.ClsplatError, match="step 3: the training has gone on"):
        step.model  # noqa: B018


def test_a_saved_trainer_is_resumed_as_a_run(whole, scene, item_device, tmp_path):
    with clsplat.Trainer(scene, TINY, output=tmp_path / "run", device=item_device) as trainer:
        next(trainer)
        next(trainer)
        trainer.save()
    assert list(trainer) == [] and not trainer.run.is_finished
    trainer.run.resume(device=item_device, scene=scene)
    assert trainer.run.is_finished and model_digest(trainer.run) == model_digest(whole[0])


def test_the_model_is_read_and_changed_between_steps(scene, item_device, tmp_path):
    trainer = clsplat.Trainer(scene, TINY, output=tmp_path / "run", device=item_device)
    before = next(trainer).model
    away = before.positions + np.float32((1, 0, 0))
    trainer.update(positions=away, log_scales=before.log_scales - 1)
    assert np.abs(trainer.model.positions - away).max() < 1e-4
    assert np.abs(trainer.model.log_scales - before.log_scales + 1).max() < 1e-5
    with pytest.raises(clsplat.ClsplatError, match="place: not a field"):
        trainer.update(place=away)
    loss = next(trainer).loss
    trainer.close()
    assert loss > 0.1 and np.abs(trainer.model.positions - away).max() < 0.2


def test_a_schedule_may_be_a_class(scene, item_device, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from halves import Halves

    trainer = clsplat.Trainer(
        scene,
        replace(TINY, schedule="sig", exposure="auto"),
        schedule=Halves,
        output=tmp_path / "run",
        device=item_device,
    )
    assert [step.level for step in trainer] == [2.0] * 3 + [1.0] * 3
    options = trainer.run.options
    assert options.schedule == "halves" and options.half_share == 0.5
    monkeypatch.delitem(sys.modules, "halves")


class Counting(clsplat.Part):
    """Counts the views that it sees, and is a term of the loss without a gradient."""

    name = "counting"
    views = 0

    def add_to(self, work, inputs):
        """As `Part.add_to`."""
        return work.frame.image

    def values(self, measured):
        """As `Part.values`."""
        self.views += len(measured)
        return {"counting": float(measured[0].download().mean())}


def test_a_part_may_be_an_argument(whole, scene, item_device, tmp_path):
    part = Counting()
    with clsplat.Trainer(scene, TINY, parts=[part], output=tmp_path / "run", device=item_device) as trainer:
        values = next(trainer).values
    assert 0.05 < values["counting"] < 1 and values["loss"] == whole[1][0] and part.views >= 1
