"""What a training leaves when its end goes wrong: what cannot be made again comes first."""

import shutil

import pytest

from clsplat.errors import InputError, Interrupted
from clsplat.io.runs.run import RunFolder
from clsplat.training import loop, recorder
from clsplat.training.photos import Photos
from tests.data.tiny_training import STILL, model_digest, records, resumed, trained

OPTIONS = {**STILL, "iterations": 12, "test_every": 16}


@pytest.fixture(scope="module")
def whole(item_device, city, tmp_path_factory):
    """A run that nothing disturbed; not to be changed."""
    return trained(tmp_path_factory.mktemp("whole") / "run", city, item_device, **OPTIONS)


def broken(error):
    def call(*_, **__):
        raise error

    return call


@pytest.mark.slow
@pytest.mark.parametrize(
    "moment, what", [("write_report", "the report"), ("pictures_of", "the pictures of its report")]
)
def test_a_report_that_cannot_be_drawn_costs_nothing_else(
    whole, item_device, city, tmp_path, monkeypatch, caplog, moment, what
):
    """Faults C5a and C5b of the hostile trial: an encoding, a font, a user's matplotlibrc."""
    monkeypatch.setattr(loop, moment, broken(UnicodeEncodeError("utf-8", "x", 0, 1, "")))
    run = trained(tmp_path / "run", city, item_device, **OPTIONS)
    assert model_digest(run) == model_digest(whole)
    assert len(records(run, "eval")) == 1
    assert f"{what} could not be drawn (UnicodeEncodeError" in caplog.text
    assert run.is_finished is (moment == "pictures_of")  # the same command draws it
    monkeypatch.undo()
    assert resumed(run, city, item_device, **OPTIONS).is_finished
    assert len(records(run, "eval")) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "moment, error",
    [
        ("evaluate_views", KeyboardInterrupt()),
        ("evaluate_views", InputError("a photo is gone")),
        ("write_report", KeyboardInterrupt()),
        ("save_model", KeyboardInterrupt()),
    ],
    ids=repr,
)
@pytest.mark.one_in(3)
def test_the_last_moments_lose_nothing(whole, item_device, city, tmp_path, monkeypatch, moment, error):
    """Fault C6: Ctrl-C in the final evaluation came before the final checkpoint."""
    where = {"evaluate_views": recorder, "write_report": loop, "save_model": RunFolder}[moment]
    monkeypatch.setattr(where, moment, broken(error))
    with pytest.raises(Interrupted if isinstance(error, KeyboardInterrupt) else InputError):
        trained(tmp_path / "run", city, item_device, **OPTIONS)
    run = RunFolder(tmp_path / "run")
    assert run.load_checkpoint()[1]["iteration"] == 12
    assert run.has_model is (moment != "save_model")
    monkeypatch.undo()
    resumed(run, city, item_device, **OPTIONS)
    assert model_digest(run) == model_digest(whole) and run.is_finished
    assert len(records(run, "eval")) == 1


def test_ctrl_c_before_the_first_step_says_how_to_go_on(whole, item_device, city, tmp_path, monkeypatch):
    monkeypatch.setattr(loop.Training, "begin", broken(KeyboardInterrupt()))
    with pytest.raises(Interrupted, match="^stopped after step 0; go on with: clsplat train --res"):
        trained(tmp_path / "run", city, item_device, **OPTIONS)
    monkeypatch.undo()
    run = resumed(RunFolder(tmp_path / "run"), city, item_device, **OPTIONS)
    assert model_digest(run) == model_digest(whole)


def test_a_run_that_moved_with_its_scene(whole, city, tmp_path):
    """Paths are relative where they can be."""
    (tmp_path / "before").mkdir()
    shutil.copytree(city.path, tmp_path / "before" / "town")
    shutil.copytree(whole.path, tmp_path / "before" / "run")
    RunFolder(tmp_path / "before" / "run").note_scene(tmp_path / "before" / "town")
    (tmp_path / "before").rename(tmp_path / "after")
    run = RunFolder.open(tmp_path / "after" / "run")
    assert run.scene_path() == tmp_path / "after" / "town"
    (tmp_path / "after" / "town").rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="no longer exists.*--scene"):
        run.scene_path()
    assert run.scene_path(tmp_path / "elsewhere") == tmp_path / "elsewhere"


def test_ctrl_c_before_a_run_is_recorded_names_no_run(item_device, city, tmp_path, monkeypatch):
    """With --overwrite, --resume would go on with the old run."""
    monkeypatch.setattr(loop, "find_warnings", broken(KeyboardInterrupt()))
    closed = []
    monkeypatch.setattr(Photos, "close", lambda photos: closed.append(photos))
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "run", city, item_device, **OPTIONS)
    assert closed and not RunFolder(tmp_path / "run").is_begun
