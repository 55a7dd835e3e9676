"""The terms of the loss: a new one is a class and a line in TERMS, and trainings have it."""

import numpy as np
import pytest

from clsplat.gaussians import Gaussians
from clsplat.io.scenes.read import read_scene
from clsplat.loss import terms
from clsplat.loss.image_loss import ImageLoss
from clsplat.loss.reproject import Reprojection
from clsplat.loss.term import FrameGradient, LossTerm, TrainingSample
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule import Plan
from clsplat.training.model import Model
from clsplat.training.step import Step
from tests import cases
from tests.data.tiny_training import CITY, STILL, options_of, records, trained
from tests.kernels.chain import camera_of, size_of

PLAN = Plan(1.0, 1, gathers=True, grows=False, resets_opacity=False, prunes_large=False, decay=0.5)


class Darkness(LossTerm):
    """A pull of the image to black: the mean of its squares."""

    name = "darkness"
    waits = True

    def weight(self, plan):
        return 20.0

    def add_to(self, grad, frame, image, sample, weight):
        values = image.download()
        grad.add(image=self.device.upload(weight * 2 * values / values.size))
        return float(np.mean(values**2))

    def values(self, measured):
        return {"darkness": float(np.mean(measured))}


class Nearness(LossTerm):
    """A pull of the summed depth to 0, which needs frames with depth."""

    name = "nearness"
    needs_depth = waits = True

    def add_to(self, grad, frame, image, sample, weight):
        shape = frame.blended.depth.shape
        grad.add(depth=self.device.upload(np.full(shape, 0.5)))
        return None


class Never(Darkness):
    """A term that no options request."""

    @classmethod
    def is_used(cls, options):
        return False


@pytest.mark.slow
def test_a_new_term_takes_part_in_a_training(item_device, tmp_path, monkeypatch):
    """The image becomes dark only because of the term, and the record says so."""
    city, lights = read_scene(CITY), {}
    for name, listed in (("without", (Never,)), ("with", (Darkness,))):
        monkeypatch.setattr(terms, "TERMS", (ImageLoss, *listed))
        run = trained(tmp_path / name, city, item_device, **STILL, iterations=100)
        steps = records(run, "step")
        assert ("darkness" in steps[0]) is (name == "with") and steps[-1]["loss"] > 0
        lights[name] = records(run, "eval")[-1]["psnr"], steps
    first, *_, last = lights["with"][1]
    assert last["darkness"] < 0.3 * first["darkness"]
    assert lights["with"][0] < lights["without"][0] - 3  # dB, of the photos


def one_step(device, monkeypatch, listed):
    """A Step with these terms, and a sample for it."""
    monkeypatch.setattr(terms, "TERMS", listed)
    case = cases.gaussians("degree_1")
    width, height = size_of(case)
    photo = np.random.default_rng(0).integers(0, 256, (3, height, width), np.uint8)
    renderer = Renderer(device, 1, case["near"])
    rows = {name: values.astype(np.float32) for name, values in case["rows"].items()}
    step = Step(renderer, Model(device, Gaussians(rows, 1), "device", True), 1.0,
                TrainOptions(iterations=100))
    return step, TrainingSample(0, renderer.pack(camera_of(case)), device.upload(photo))


def trained_once(device, monkeypatch, *listed):
    step, sample = one_step(device, monkeypatch, listed)
    step.run(1, PLAN, [sample])


def stepped(device, monkeypatch, *listed):
    """(gradients given to the adjoint, the frame, rows after a step) with these terms."""
    step, sample = one_step(device, monkeypatch, listed)
    renderer = step.renderer
    given, adjoint = [], renderer.adjoint

    def noted(rows, frame, image, depth, transmittance, *more):
        grads = image, depth, transmittance
        given.append((frame, [None if grad is None else grad.download() for grad in grads]))
        return adjoint(rows, frame, *grads, *more)

    monkeypatch.setattr(renderer, "adjoint", noted)
    monkeypatch.setattr(ImageLoss, "waits", True)  # as `noted` does
    step.run(1, PLAN, [sample])
    [(frame, grads)] = given
    return grads, frame, step.model.download().rows


@pytest.mark.one_in(2)
def test_gradients_of_terms_are_added(device, monkeypatch):
    (alone, *nothing), frame, rows = stepped(device, monkeypatch, ImageLoss)
    (both, *none), _, moved = stepped(device, monkeypatch, ImageLoss, Darkness)
    image = frame.image.download()
    assert np.allclose(both - alone, 40 * image / image.size, atol=1e-6 * np.abs(both).max())
    assert nothing == none == [None, None] and np.abs(both - alone).max() > 0
    assert any(not np.array_equal(rows[name], moved[name]) for name in rows)


def test_a_term_that_needs_depth_has_it(device, monkeypatch):
    (_, depth, transmittance), frame, rows = stepped(device, monkeypatch, ImageLoss, Nearness)
    assert frame.with_depth and transmittance is None
    assert np.array_equal(depth, np.full(frame.blended.depth.shape, 0.5))
    _, frame, without = stepped(device, monkeypatch, ImageLoss)
    assert not frame.with_depth
    assert not np.array_equal(rows["positions"], without["positions"])


def test_a_term_that_does_not_say_that_it_waits_is_refused(item_device, monkeypatch):
    monkeypatch.setattr(Darkness, "waits", False)
    with pytest.raises(RuntimeError, match="must not wait"):
        trained_once(item_device, monkeypatch, Darkness)


class Brightness(LossTerm):
    """A term that computes with its weight on the host, and does not say that it waits."""

    name = "brightness"

    def add_to(self, grad, frame, image, sample, weight):
        grad.add(image=self.device.empty(image.shape))
        return 2 * weight


def test_a_weight_is_passed_to_kernels_as_it_is(item_device, monkeypatch):
    """Later steps would repeat the work of the first weight."""
    with pytest.raises(TypeError, match="as it is"):
        trained_once(item_device, monkeypatch, Brightness)


@pytest.mark.parametrize("name", ["image", "depth", "transmittance"])
def test_gradients_add_up(device, name):
    first, second, third = np.random.default_rng(0).normal(size=(3, 3, 70, 41)).astype(np.float32)
    grad = FrameGradient()
    for values in (first, second, third):
        grad.add(**{name: device.upload(values)})
    expected = device.real.type(first) + second + third
    assert np.allclose(getattr(grad, name).download(), expected, atol=1e-6)
    assert sum(value is None for value in vars(grad).values()) == 2


def test_options_and_plans_decide_which_terms_there_are(item_device):
    used = [type(term) for term in terms.terms_of(item_device, options_of())]
    assert used == [ImageLoss]
    term = Reprojection(item_device, options_of())
    assert Reprojection.is_used(options_of(schedule="sig", reproject="on", reset_every=0))
    assert term.weight(PLAN) == 0
