"""What is not finite: gradients are skipped, counted and told of; what is spoilt is never saved."""


import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.training import checkpoint, loop, recorder, step
from clsplat.training.parts import image_term
from clsplat.training.progress import SilentProgress
from clsplat.training.step import SkippedGradients
from tests.data.tiny_model import write_scene
from tests.data.tiny_training import model_digest, records

STEPS, EVERY = 40, 10  # of the run; between records and checkpoints


class Counter:
    """What a kernel counts on: uint[1]."""

    def __init__(self, value=0):
        self.value = value

    def add(self, rows):
        self.value = (self.value + rows) % 2**32

    def last(self):
        return np.uint32(self.value)


def test_counting():
    """Since the last record and over all, each look told of the first only."""
    counter = Counter()
    counts = SkippedGradients(counter)
    assert not counts.poll(0) and counts.total == 0
    told = []
    for rows, requested in ((0, 50), (3, 100), (4, 120)):
        counter.add(rows)
        told.append(counts.poll(requested))
    assert told == [False, True, False] and counts.total == 7
    assert counts.close() == (7, 120) and counts.close() == (0, 0)
    counter.add(5)
    assert not counts.poll(129) and counts.total == 12 and counts.close() == (5, 9)


def test_counting_past_what_32_bits_hold():
    """Also by a resumed run, whose counters begin at zero again."""
    counter, other = Counter(), Counter()
    counts = SkippedGradients(counter)
    for _ in range(3):
        counter.add(2**31)
        counts.poll(0)
    again = SkippedGradients(other)
    again.load(counts.state())
    other.add(1)
    again.poll(0)
    assert counts.total == 3 * 2**31 and again.close() == (3 * 2**31 + 1, 0)


def test_counting_on_several_counters():
    rows, exposures = Counter(), Counter(2**32 - 1)
    counts = SkippedGradients(rows, exposures)
    assert counts.poll(0) and counts.close() == (2**32 - 1, 0)
    rows.add(3)
    exposures.add(2)  # past its 32 bits
    counts.poll(0)
    assert counts.close() == (5, 0)


@pytest.mark.parametrize("value, good", [(1e38, True), (np.nan, False), (np.inf, False),
                                         (-np.inf, False)])
@pytest.mark.parametrize("shape", [(3,), (4, 2, 3)])
def test_finite(value, good, shape):
    values = np.zeros(shape, np.float32)
    values[(1,) * len(shape)] = value
    assert checkpoint._is_finite(values) == good
    assert checkpoint._is_finite(values[:0])


# --- in a training

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
        options = resolve({}, {
            "schedule": "constant", "iterations": STEPS, "test_every": 4, "sh_degree": 0,
            "densify_from": 1000, "checkpoint_every": EVERY, **changes})
        if resumes:
            run = RunFolder.open(tmp_path / folder)
            loop.resume(scene, options, item_device, run, Progress())
        else:
            run = RunFolder.create(tmp_path / folder)
            loop.train(scene, options, item_device, run, Progress())
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
                values[:, :int(np.ceil(share * values.shape[1]))] = np.nan
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
    message, = [text for text in train.messages if "finite" in text]
    assert message.startswith(f"step 15: {counted:,} gradients were not finite and were skipped")
    assert_finite(run)
    assert all(np.isfinite(record["loss"]) for record in steps.values())


@pytest.mark.slow
def test_a_resumed_run_counts_on(train, poison, monkeypatch):
    """Stopped between two records, after some were skipped and told of."""
    monkeypatch.setattr(recorder, "TOO_MANY", 0.5)
    poison(13, 13)
    whole = train("whole")
    poison(13, 13)
    with pytest.raises(loop.Interrupted):
        train(stop_at=13)
    poison(0, 0)
    run = train(resumes=True)
    keys = ("iteration", "skipped_rows", "skipped_since", "loss")
    assert [[record[key] for key in keys] for record in records(run, "step")] == [
        [record[key] for key in keys] for record in records(whole, "step")]
    assert len([text for text in train.messages if "finite" in text]) == 2  # once a run
    assert model_digest(run) == model_digest(whole)


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
def test_how_many_are_too_many(train, poison, monkeypatch):
    """The limit is a share of the gradients asked for: just below it the run goes on."""
    poison(13, 13)
    with pytest.raises(InputError) as caught:
        train()
    many, asked = (int(word.replace(",", "")) for word in
                   str(caught.value).partition(": ")[2].split()[0:3:2])
    assert 0 < many < asked and recorder.TOO_MANY == 0.01
    for limit, folder in ((many / asked, "below"), (0.999 * many / asked, "above")):
        monkeypatch.setattr(recorder, "TOO_MANY", limit)
        poison(13, 13)
        if folder == "above":
            with pytest.raises(InputError):
                train(folder)
        else:
            assert train(folder).has_model


@pytest.mark.slow
def test_the_first_step_alone_ends_nothing(train, poison):
    poison(1, 1)
    assert records(train(), "step")[0]["skipped_since"] > 0


@pytest.mark.slow
def test_without_a_checkpoint_none_is_promised(train, poison):
    poison(1, STEPS)
    with pytest.raises(InputError, match="; there is no checkpoint yet: "):
        train(checkpoint_every=0)


@pytest.mark.slow
def test_spoilt_parameters_are_not_saved(train, monkeypatch):
    """A nan that came from elsewhere, behind step 15."""
    follow = step.Step.densify

    def spoil(self, iteration, *arguments):
        if iteration == 15:
            self.model.rows["log_scales"].write(np.full((1, 3), np.nan), first_row=2)
        return follow(self, iteration, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(step.Step, "densify", spoil)
        with pytest.raises(InputError, match="run: row.log_scales at step 20: not finite; the "
                                             "last checkpoint is kept: ") as caught:
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


@pytest.mark.slow
def test_exposures_stay_as_they_are(train, poison, monkeypatch):
    """In poisoned steps a view's transform, its moments and its count do not move; each is counted
    as a row beside those of gaussians."""
    monkeypatch.setattr(recorder, "TOO_MANY", 1.0)
    counted = []
    for exposure in ("off", "on"):
        poison(1, STEPS, share=0.1)
        run = train(exposure, exposure=exposure)
        counted.append([record["skipped_rows"] for record in records(run, "step")])
    assert counted[1][0] == counted[0][0] + 1  # later, as gaussians differ, they skip others
    still = run.load_checkpoint()[0]
    assert np.array_equal(still["exposure.transforms"], np.tile(np.eye(3, 4).ravel(), (3, 1)))
    assert not still["exposure.steps"].any() and not still["exposure.v"].any()
    poison(13, 13)
    run = train(exposure="on")
    assert_finite(run)
    arrays, _ = run.load_checkpoint()
    assert arrays["exposure.steps"].sum() == STEPS - 1 and arrays["exposure.v"].all()
