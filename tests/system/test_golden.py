"""Ten golden losses: the kernels train as a trainer of nothing but the float64 references."""

import json

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule.constant import Constant
from clsplat.training.model import Model
from clsplat.training.part import TrainingSample
from clsplat.training.parts.image_term import ImageTerm
from clsplat.training.step import Step
from tests.kernels.chain import precision_of
from tests.system import golden

RELATIVE = {"float": 1e-4, "double": 1e-8}


def stored():
    return json.loads(golden.STORED.read_text())["losses"]


def test_the_reference_still_gives_them():
    assert np.allclose(golden.losses(), stored(), rtol=1e-9, atol=0)


def test_they_fall():
    """Each view's loss; a trainer that does nothing would keep it."""
    by_view = [stored()[view::3] for view in range(3)]
    assert all(last < 0.97 * first for first, *_, last in by_view)


@pytest.mark.one_in(2)
def test_kernels_give_them(device):
    rows, cameras, photos = golden.scene()
    renderer = Renderer(device, golden.DEGREE, golden.NEAR, background=golden.BACKGROUND)
    model = Model(device, Gaussians(rows, golden.DEGREE))
    options = TrainOptions(
        iterations=golden.STEPS,
        sh_every=golden.SH_EVERY,
        sh_degree=golden.DEGREE,
        ssim_weight=golden.SSIM_WEIGHT,
        opacity_rate=golden.RATES["opacity_logits"],
        average=0.0,
    )
    step = Step(renderer, model, golden.EXTENT, 0.0, options, [ImageTerm(golden.SSIM_WEIGHT)])
    schedule = Constant(options, None)
    packed = [
        renderer.pack(
            Camera(c["width"], c["height"], (c["fx"], c["fy"]), (c["cx"], c["cy"]), c["rotation"], c["translation"])
        )
        for c in cameras
    ]
    planes = [device.upload(photo) for photo in photos]
    losses = []
    for iteration in range(1, golden.STEPS + 1):
        view = iteration % 3
        measured = step.run(iteration, schedule.plan(iteration), [TrainingSample(view, packed[view], planes[view])])
        losses.append(step.values(measured)["loss"])
    assert np.allclose(losses, stored(), rtol=RELATIVE[precision_of(device)], atol=0), f"{losses}\nexpected {stored()}"
