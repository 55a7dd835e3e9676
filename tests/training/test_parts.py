"""Parts of a training: what a step asks of them, and parts that a training is given."""

import importlib.util
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.cities.scene import FrozenRows, SampleWeights
from clsplat.errors import InputError, Interrupted
from clsplat.gaussians import Gaussians
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule.plan import Plan
from clsplat.training.model import Model
from clsplat.training.part import FrameGradient, Part, TrainingSample, overriding
from clsplat.training.parts import PARTS
from clsplat.training.parts.image_term import ImageTerm
from clsplat.training.run import train
from clsplat.training.step import Step
from tests import cases
from tests.data.tiny_training import CITY, STILL, model_digest, options_of, records, resume
from tests.kernels.chain import camera_of, size_of

PLAN = Plan(1.0, 1, gathers=True, grows=False, resets_opacity=False, prunes_large=False, decay=0.5)


@dataclass  # whose instances have no hash
class Darkness(Part):
    """A pull of the image to black: the mean of its squares."""

    name = "darkness"
    waits = True

    def add_to(self, work, inputs):
        image = work.frame.exposed.download()
        work.grad.add(image=work.counts.device.upload(20 * 2 * image / image.size))
        return float(np.mean(image**2))

    def values(self, measured):
        return {"darkness": float(np.mean(measured))}


class Nearness(Part):
    """A pull of the summed depth to 0, which needs frames with depth."""

    name = "nearness"
    needs_depth = waits = True

    def add_to(self, work, inputs):
        work.grad.add(depth=work.counts.device.upload(np.full(work.frame.blended.depth.shape, 0.5)))


@pytest.mark.slow
def test_a_given_part_takes_part_in_a_training(item_device, tmp_path):
    """The image becomes dark only because of the term, and the record says so."""
    city, lights = read_scene(CITY), {}
    for name, parts in (("without", ()), ("with", (Darkness(),))):
        run = RunFolder.create(tmp_path / name)
        train(city, options_of(**STILL, iterations=100), item_device, run, parts=parts)
        steps = records(run, "step")
        assert ("darkness" in steps[0]) is (name == "with") and steps[-1]["loss"] > 0
        lights[name] = records(run, "eval")[-1]["psnr"], steps
    first, *_, last = lights["with"][1]
    assert last["darkness"] < 0.3 * first["darkness"]
    assert lights["with"][0] < lights["without"][0] - 3  # dB, of the photos


def one_step(device, *parts):
    """A Step with these parts, and a sample for it."""
    case = cases.gaussians("degree_1")
    width, height = size_of(case)
    photo = np.random.default_rng(0).integers(0, 256, (3, height, width), np.uint8)
    renderer = Renderer(device, 1, case["near"])
    rows = {name: values.astype(np.float32) for name, values in case["rows"].items()}
    step = Step(renderer, Model(device, Gaussians(rows, 1), "device"), 1.0, 1e-3, TrainOptions(iterations=100), parts)
    return step, TrainingSample(0, renderer.pack(camera_of(case)), device.upload(photo))


def stepped(device, monkeypatch, *parts):
    """(gradients given to the adjoint, the frame, rows after a step) with these parts."""
    step, sample = one_step(device, *parts)
    renderer = step.renderer
    given, adjoint = [], renderer.adjoint

    def noted(rows, frame, image, depth, transmittance, *more):
        grads = image, depth, transmittance
        given.append((frame, [None if grad is None else grad.download() for grad in grads]))
        return adjoint(rows, frame, *grads, *more)

    monkeypatch.setattr(renderer, "adjoint", noted)
    monkeypatch.setattr(ImageTerm, "waits", True)  # as `noted` does
    step.run(1, PLAN, [sample])
    [(frame, grads)] = given
    return grads, frame, step.model.download().rows


@pytest.mark.one_in(2)
def test_gradients_of_terms_are_added(device, monkeypatch):
    (alone, *nothing), frame, rows = stepped(device, monkeypatch, ImageTerm())
    (both, *none), _, moved = stepped(device, monkeypatch, ImageTerm(), Darkness())
    image = frame.image.download()
    assert np.allclose(both - alone, 40 * image / image.size, atol=1e-6 * np.abs(both).max())
    assert nothing == none == [None, None] and np.abs(both - alone).max() > 0
    assert any(not np.array_equal(rows[name], moved[name]) for name in rows)


def test_a_term_that_needs_depth_has_it(device, monkeypatch):
    (_, depth, transmittance), frame, rows = stepped(device, monkeypatch, ImageTerm(), Nearness())
    assert frame.with_depth and transmittance is None
    assert np.array_equal(depth, np.full(frame.blended.depth.shape, 0.5))
    _, frame, without = stepped(device, monkeypatch, ImageTerm())
    assert not frame.with_depth
    assert not np.array_equal(rows["positions"], without["positions"])


def test_a_part_that_waits_without_saying_so_is_refused(item_device, monkeypatch):
    monkeypatch.setattr(Darkness, "waits", False)
    step, sample = one_step(item_device, ImageTerm(), Darkness())
    with pytest.raises(RuntimeError, match="must not wait"):
        step.run(1, PLAN, [sample])


class Weighted(Part):
    """Computes with one of its inputs in Python, without saying that it waits."""

    name = "weighted"

    def inputs(self, now, sample):
        return {"weight": now.progress}

    def add_to(self, work, inputs):
        return 2.0 if inputs["weight"] > 0.5 else 1.0


def test_an_input_that_python_computes_with_is_refused(item_device):
    """Later steps would repeat the work of the first weight."""
    step, sample = one_step(item_device, ImageTerm(), Weighted())
    with pytest.raises(TypeError, match="Input"):
        step.run(1, PLAN, [sample])


class Odd(Part):
    """Takes part in every other view, and counts the calls of the hooks of a step."""

    name = "odd"

    def __init__(self):
        self.called = []

    def inputs(self, now, sample):
        return {"number": now.iteration} if sample.view % 2 else None


for _hook in ("camera", "respond", "add_to", "adjoint", "learn", "move"):
    setattr(Odd, _hook, lambda self, work, inputs, hook=_hook: self.called.append(hook))


def test_hooks_are_called_in_order_where_a_part_takes_part(item_device):
    """Once for each kind of step, as later ones are replayed."""
    part = Odd()
    step, sample = one_step(item_device, ImageTerm(), part)
    step.run(1, PLAN, [sample])
    assert part.called == []
    for iteration in (2, 3, 4):
        step.run(iteration, PLAN, [TrainingSample(1, sample.camera, sample.photo)])
    step.settle()
    assert part.called == ["camera", "respond", "add_to", "adjoint", "learn", "move"]


@pytest.mark.parametrize("name", ["image", "depth", "transmittance"])
def test_gradients_add_up(device, name):
    first, second, third = np.random.default_rng(0).normal(size=(3, 3, 70, 41)).astype(np.float32)
    grad = FrameGradient()
    for values in (first, second, third):
        grad.add(**{name: device.upload(values)})
    expected = device.real.type(first) + second + third
    assert np.allclose(getattr(grad, name).download(), expected, atol=1e-6)
    assert sum(value is None for value in vars(grad).values()) == 2


def test_parts_have_names_of_their_own_and_use_every_hook():
    names, hooks = (
        [part.name for part in PARTS],
        [name for name, value in vars(Part).items() if callable(value) and name != "decide"],
    )
    assert len(set(names)) == len(names) and not any("." in name for name in names)
    parts = [*(part() for part in PARTS), FrozenRows(None), SampleWeights({})]
    assert [hook for hook in hooks if not overriding(parts, hook)] == []


@pytest.mark.slow
def test_the_example_learns_and_resumes_to_the_same_bytes(item_device, tmp_path):
    spec = importlib.util.spec_from_file_location(
        "learned_scale", Path(__file__).parents[2] / "docs/examples/learned_scale.py"
    )
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    city, options = read_scene(CITY), options_of(**STILL, iterations=60, exposure="off")

    def run(name, *parts, **changes):
        folder = RunFolder.create(tmp_path / name)
        with suppress(Interrupted):
            train(city, replace(options, **changes), item_device, folder, parts=parts)
        return folder

    whole, plain = run("whole", example.CauchyLoss(0.3)), run("plain")
    assert model_digest(whole) != model_digest(plain)
    log_scale, *_, steps = whole.load_checkpoint()[0]["cauchy.learned"]
    assert steps == 60 and abs(log_scale - np.log(0.1)) > 0.1
    part = run("part", example.CauchyLoss(0.3), stop_at=25)
    with pytest.raises(InputError, match="was trained with the part cauchy; resume it with that"):
        resume(city, options, item_device, part)
    resume(city, options, item_device, part, parts=[example.CauchyLoss(0.3)])
    assert model_digest(part) == model_digest(whole)
