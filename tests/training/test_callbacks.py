"""A callback that raises: the step is finished and saved, then its exception goes on."""

import shlex

import pytest

import clsplat
from clsplat.errors import Interrupted
from clsplat.io.runs.run import RunFolder
from clsplat.training.loop import Training
from tests.data.tiny_training import CITY

TINY = clsplat.TrainOptions(
    iterations=6, downscale=8.0, sh_degree=0, exposure="off", init="sfm", test_every=0, sphere=False
)


def raising(error, at=3, event="step"):
    def callback(record):
        if record["event"] == event and record["iteration"] >= at:
            raise error

    return callback


@pytest.mark.parametrize(
    "error",
    [
        ValueError("mine"),
        SystemExit(3),
        RuntimeError("mine"),
        MemoryError(),
        pytest.param(clsplat.ClsplatError("mine"), id="ClsplatError"),
    ],
)
@pytest.mark.slow
@pytest.mark.one_in(3)
def test_what_a_callback_raises_goes_on_after_the_checkpoint(tmp_path, item_device, error):
    with pytest.raises(type(error)) as caught:
        clsplat.train(CITY, TINY, output=tmp_path / "run", device=item_device, callbacks=[raising(error)])
    assert caught.value is error
    assert RunFolder(tmp_path / "run").checkpoint_iteration() == 3


@pytest.mark.parametrize("event, at, saved", [("step", 3, 3), ("plan", 0, 0), ("step", 6, 6)])
@pytest.mark.one_in(3)
def test_ctrl_c_in_a_callback_promises_what_was_saved(tmp_path, item_device, event, at, saved):
    run = tmp_path / "run"
    with pytest.raises((Interrupted, KeyboardInterrupt)) as caught:
        clsplat.train(CITY, TINY, output=run, device=item_device, callbacks=[raising(KeyboardInterrupt(), at, event)])
    assert RunFolder(run).checkpoint_iteration() == saved
    assert str(caught.value) == (
        f"stopped after step {saved}; go on with: clsplat train --resume -o {shlex.quote(str(run))}"
    )


@pytest.mark.slow
def test_an_interrupt_before_the_first_checkpoint_promises_none(tmp_path, item_device, monkeypatch, caplog):
    def broken_off(self):
        if self.session.iteration == 2:
            raise KeyboardInterrupt  # a second Ctrl-C, within a step
        return step(self)

    step, run = Training.take_step, tmp_path / "run"
    with (
        monkeypatch.context() as changed,
        pytest.raises(
            Interrupted,
            match=("stopped after step 2, before its first checkpoint; to begin again: clsplat train --res"),
        ),
    ):
        changed.setattr(Training, "take_step", broken_off)
        clsplat.train(CITY, TINY, output=run, device=item_device)
    clsplat.Run.open(run).resume(device=item_device)
    assert "has no checkpoint, so the training begins again at step 1" in caplog.text
    assert clsplat.Run.open(run).is_finished
