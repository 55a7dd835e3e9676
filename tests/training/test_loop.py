"""When the training loop writes checkpoints."""

from types import SimpleNamespace

import pytest

from clsplat.io.scenes.read import read_scene
from clsplat.schedule.sig import Sig
from clsplat.training import loop
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.loop import SAVE_SECONDS, SAVE_SHARE, Training
from tests.data.tiny_training import CITY, trained


@pytest.mark.parametrize(
    "elapsed, took, gaussians, saves",
    [
        (SAVE_SECONDS - 0.1, 0.0, 1000, False),
        (SAVE_SECONDS, 0.0, 1000, True),
        (SAVE_SECONDS, 1.0, 1000, True),
        (SAVE_SECONDS + 9, 2.0, 1000, False),
        (2 / SAVE_SHARE, 2.0, 1000, True),
        (180.0, 0.0, 10**7, False),
        (190.0, 0.0, 10**7, True),
        (180.0, 2.0, 10**7, True),
    ],
)
def test_every_half_minute_but_not_for_most_of_the_time(elapsed, took, gaussians, saves):
    """The first one is expected to be written at a gigabyte a second."""
    training = SimpleNamespace(
        session=(
            session := SimpleNamespace(
                options=SimpleNamespace(checkpoint_every="auto", sh_degree=3), step=SimpleNamespace(count=gaussians)
            )
        ),
        checkpoint=Checkpoint(None, session, None, None, ""),
        clock=SimpleNamespace(elapsed=lambda: 100.0 + elapsed),
        _saved_at=100.0,
        _save_seconds=took,
    )
    assert Training._saves(training) == saves


@pytest.mark.slow
@pytest.mark.parametrize(
    "every, seconds, steps",
    [("auto", 1e9, [12]), ("auto", 0.0, list(range(1, 13))), (5, 0.0, [5, 10, 12]), (0, 0.0, [12])],
)
def test_after_which_steps(item_device, tmp_path, monkeypatch, every, seconds, steps):
    written, taken = [], Checkpoint.taken
    monkeypatch.setattr(Checkpoint, "taken", lambda self: (written.append(self.session.iteration), taken(self))[1])
    monkeypatch.setattr(loop, "SAVE_SECONDS", seconds)
    monkeypatch.setattr(loop, "SAVE_SHARE", 1e9)
    trained(
        tmp_path / "run",
        read_scene(CITY).part(range(6)),
        item_device,
        iterations=12,
        checkpoint_every=every,
        eval_every=0,
        exposure="off",
    )
    assert written == steps


def test_a_level_is_recorded_after_the_step_before_it(item_device, tmp_path, monkeypatch):
    """A curve of levels jumped back if a step or an evaluation of the same iteration followed."""

    def observe(self, iteration, frequency):
        if iteration == 6:
            self.index, self.began = 1, 6
            return {"level": 1.0}

    monkeypatch.setattr(Sig, "observe_every", 3)
    monkeypatch.setattr(Sig, "observe", observe)
    monkeypatch.setattr("clsplat.training.recorder.LOG_EVERY", 6)
    monkeypatch.setattr("clsplat.training.recorder.REPORT_EVERY", 6)
    run = trained(
        tmp_path / "run",
        read_scene(CITY).part(range(6)),
        item_device,
        schedule="sig",
        levels=(2.0, 1.0),
        downscale=4.0,
        iterations=12,
        eval_every=3,
        exposure="off",
        init="sfm",
        test_every=3,
        sphere=False,
        rounds=1,
    )
    found = [(r["event"], r["iteration"], r["level"]) for r in run.records()]
    place = found.index(("level", 6, 1.0))
    assert {("step", 6, 2.0), ("eval", 6, 2.0)} <= set(found[:place])
    assert {level for _, _, level in found[:place]} == {2.0}
    assert {level for _, _, level in found[place:]} == {1.0}
