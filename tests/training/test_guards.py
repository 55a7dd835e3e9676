"""What is not finite: gradients are skipped, counted and told of; what is spoilt is never saved."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.training import loop, recorder
from clsplat.training import run as trainings
from clsplat.training.parts import image_term
from clsplat.training.progress import SilentProgress
from tests.data.tiny_model import write_scene
from tests.data.tiny_training import model_digest, records

STEPS, EVERY = 40, 10  # of the run; between records and checkpoints


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return read_scene(write_scene(tmp_path_factory.mktemp("scene")))


@pytest.fixture
def often(monkeypatch):
    """Records and looks as often as a run of a few steps wants."""
    monkeypatch.setattr(loop, "LOG_EVERY", EVERY)
    monkeypatch.setattr(recorder, "LOG_EVERY", EVERY)
    monkeypatch.setattr(recorder, "REPORT_EVERY", EVERY // 2)


@pytest.fixture
def train(item_device, often, scene, tmp_path):
    """train(**options): a run of its own, on the device; .messages: what the user was told."""

    class Progress(SilentProgress):
        def message(self, text):
            messages.append(text)

    def train(folder="run", resumes=False, **changes):
        options = resolve(
            {},
            {
                "schedule": "constant",
                "iterations": STEPS,
                "test_every": 4,
                "sh_degree": 0,
                "densify_from": 1000,
                "checkpoint_every": EVERY,
                **changes,
            },
        )
        if resumes:
            run = RunFolder.open(tmp_path / folder)
            trainings.resumed(scene, options, item_device, run, Progress()).take()
        else:
            run = RunFolder.create(tmp_path / folder)
            trainings.train(scene, options, item_device, run, Progress())
        return run

    messages = train.messages = []
    return train


@pytest.fixture
def poison(monkeypatch):
    """poison(first, last, share): in those steps, so much of the image's gradient is nan."""

    def poison(first, last, share=1.0):
        calls = []

        def poisoned(device, image, photo, weight):
            calls.append(1)
            sums, grad_image = original(device, image, photo, weight)
            if first <= len(calls) <= last:
                values = grad_image.download()
                values[:, : int(np.ceil(share * values.shape[1]))] = np.nan
                grad_image.write(values)
            return sums, grad_image

        monkeypatch.setattr(image_term, "image_loss", poisoned)
        monkeypatch.setattr(image_term.ImageTerm, "waits", True)

    original = image_term.image_loss
    return poison


def assert_finite(run):
    arrays, _ = run.load_checkpoint()
    for name, values in arrays.items():
        assert np.isfinite(values).all(), name


@pytest.mark.slow
def test_some_are_skipped_counted_and_told_of_once(train, poison, monkeypatch):
    """A poisoned step of ten is more than one in a hundred: the limit is moved, see below."""
    monkeypatch.setattr(recorder, "TOO_MANY", 0.5)
    poison(13, 13)
    run = train()
    steps = {record["iteration"]: record for record in records(run, "step")}
    counted = steps[20]["skipped_rows"]
    assert counted > 0
    assert [steps[i]["skipped_rows"] for i in (1, 10, 20, 30, 40)] == [0, 0] + 3 * [counted]
    assert [steps[i]["skipped_since"] for i in (1, 10, 20, 30, 40)] == [0, 0, counted, 0, 0]
    (message,) = [text for text in train.messages if "finite" in text]
    assert message.startswith(f"step 15: {counted:,} gradients were not finite and were skipped")
    assert_finite(run)
    assert all(np.isfinite(record["loss"]) for record in steps.values())


@pytest.mark.slow
def test_too_many_end_the_run_and_keep_the_last_checkpoint(train, poison):
    poison(11, STEPS)
    with pytest.raises(InputError) as caught:
        train()
    said = str(caught.value)
    assert "gradients were not finite in the 10 steps to 20; the last checkpoint is kept: " in said
    assert "\n" not in said
    run = RunFolder.open(caught.value.args[0].partition(":")[0])
    assert run.load_checkpoint()[1]["iteration"] == 10
    assert records(run, "step")[-1]["skipped_since"] > 0 and not run.has_model
    poison(0, 0)
    assert model_digest(train(resumes=True)) == model_digest(train("healthy"))


@pytest.mark.slow
def test_spoilt_parameters_are_not_saved(train, monkeypatch):
    """A nan that came from elsewhere, behind step 15."""
    follow = loop.densify

    def spoil(step, iteration, *arguments):
        if iteration == 15:
            step.model.rows["log_scales"].write(np.full((1, 3), np.nan), first_row=2)
        return follow(step, iteration, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "densify", spoil)
        with pytest.raises(
            InputError, match="run: row.log_scales at step 20: not finite; the last checkpoint is kept: "
        ) as caught:
            train()
    run = RunFolder.open(caught.value.args[0].partition(":")[0])
    assert run.load_checkpoint()[1]["iteration"] == 10
    assert model_digest(train(resumes=True)) == model_digest(train("healthy"))


@pytest.mark.slow
def test_a_spoilt_end_leaves_no_model(train, monkeypatch):
    """The last steps are checked, too, wherever the run ends."""
    monkeypatch.setattr(image_term, "loss_value", lambda *_: (np.nan,) * 3)
    monkeypatch.setattr(recorder.Recorder, "stepped", lambda *_: None)
    with pytest.raises(InputError, match="run: the loss at step 13 is nan; there is no") as caught:
        train(iterations=13, checkpoint_every=0)
    run = RunFolder.open(caught.value.args[0].partition(":")[0])
    assert not run.has_model and not run.has_checkpoint
