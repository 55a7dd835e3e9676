"""Units of work that lack room are repeated, and the training ends in the same bytes."""

import weakref

import numpy as np
import pytest

from clsplat.training import capacity, growth, loop, photos
from tests.city.test_block import block_of, trained_block
from tests.data.tiny_training import LEVELLED, model_digest, records, trained

STEPS = {
    "iterations": 40,
    "densify_from": 10,
    "densify_every": 10,
    "densify_until": 40,
    "reset_every": 25,
    "sh_degree": 1,
    "sh_every": 15,
    "exposure": "on",
}
LEVELS = {**LEVELLED, "iterations": 60}
TRAININGS = {
    "sig batch": {**LEVELS, "batch": 2},
    "constant": {**STEPS, "schedule": "constant"},
    "taming": {**STEPS, "schedule": "taming"},
    "mcmc batch": {**STEPS, "schedule": "mcmc", "batch": 2},
    "sig": LEVELS,
    "block": {**STEPS, "schedule": "constant", "test_every": 0},
}


@pytest.fixture
def repeated(monkeypatch):
    """A list of the sizes of frames that lacked room."""
    sizes, enlarge = [], capacity.FrameCapacity.grow

    def noted(self, rows, camera, *size):
        if self.is_known(*size, with_depth=False):
            sizes.append(size)
        enlarge(self, rows, camera, *size)

    monkeypatch.setattr(capacity.FrameCapacity, "grow", noted)
    return sizes


def scarce(monkeypatch, repeated):
    """Room for a third of what the first view needs, and later for what has been seen."""
    choose, forget = capacity.FrameCapacity.room, capacity.FrameCapacity.reset
    lacked_before = [0]

    def forgotten(*arguments):
        lacked_before[0] = len(repeated)
        forget(*arguments)

    def room(*arguments):
        with monkeypatch.context() as patch:
            if len(repeated) == lacked_before[0]:
                patch.setattr(capacity, "MARGIN", 0.3)
            return choose(*arguments)

    monkeypatch.setattr(capacity, "MARGIN", 1.0)
    monkeypatch.setattr(capacity.FrameCapacity, "reset", forgotten)
    monkeypatch.setattr(capacity.FrameCapacity, "room", room)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAININGS)
@pytest.mark.one_in(5)
def test_a_training_that_lacks_room_ends_in_the_same_bytes(item_device, city, tmp_path, monkeypatch, repeated, name):
    same_bytes(item_device, city, tmp_path, monkeypatch, repeated, name)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["taming", "sig batch"])  # between them, every kernel of a step
def test_so_it_does_in_the_group_form(group_device, city, tmp_path, monkeypatch, repeated, name):
    if group_device.real == np.float32:
        same_bytes(group_device, city, tmp_path, monkeypatch, repeated, name)


def same_bytes(device, city, tmp_path, monkeypatch, repeated, name):
    scene, train, ends = city, trained, []
    if name == "block":
        scene, train = block_of(city), trained_block
    for margin in ("ample", "scarce"):
        repeated.clear()
        if margin == "ample":
            monkeypatch.setattr(capacity, "MARGIN", 3.0)
        else:
            scarce(monkeypatch, repeated)
        run = train(tmp_path / margin, scene, device, **TRAININGS[name])
        steps = [
            (record["iteration"], record["loss"], record["pixel_pairs"], record["skipped_rows"])
            for record in records(run, "step")
        ]
        grown = [(record["gaussians"], record["pixel_pairs"]) for record in records(run, "grow")]
        ends.append((model_digest(run), steps, grown))
        assert len(repeated) == 0 if margin == "ample" else len(repeated) > 2
    assert ends[0] == ends[1] and len(ends[0][2]) > 1


def test_steps_that_are_pending_keep_few_photos(item_device, city, tmp_path, monkeypatch):
    """Where photos do not stay on the device, as there is no memory for them."""
    read, made, alive = photos.Photos.__getitem__, [], []

    def noted(own, index):
        photo = read(own, index)
        made.append(weakref.ref(photo))
        alive.append(sum(each() is not None for each in made))
        return photo

    monkeypatch.setattr(photos, "DEVICE_SHARE", 0.0)
    monkeypatch.setattr(photos.Photos, "__getitem__", noted)
    trained(tmp_path, city, item_device, **{**STEPS, "schedule": "constant", "iterations": 60, "densify_from": 1000})
    assert len(alive) > 50 and max(alive) < 12


@pytest.mark.slow
def test_growth_decides_by_rows_that_have_caught_up(item_device, city, tmp_path, monkeypatch):
    """Adam leaves rows behind that no view sees."""
    current, behind = [], []
    made, densify = growth.Round, growth.densify

    def noted(*arguments):
        current.append(models[-1].adam.is_current)
        return made(*arguments)

    def before(step, *arguments):
        models.append(step._model)
        behind.append(not step._model.adam.is_current)
        return densify(step, *arguments)

    models = []
    monkeypatch.setattr(growth, "Round", noted)
    monkeypatch.setattr(loop, "densify", before)
    trained(tmp_path, city, item_device, **{**STEPS, "schedule": "constant", "iterations": 35})
    assert len(current) > 1 and all(current) and any(behind)
