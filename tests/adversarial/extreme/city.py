"""A city of many gaussians in float32 against the double build of the same kernels, which the
kernel tests hold to the numpy reference within 1e-10.

Two things are none of the arithmetic's doing, and are taken out. Which of two gaussians of the same
depth to rounding is in front: the double build takes visibility and order from the float build.
Which pixels a threshold decides (alpha at 1/255 or 0.99, transmittance at 1e-4) by less than
UNDECIDED: there the image has a step, seen as its second difference by all opacities; those pixels
have no cotangent, are not compared, and are counted.
"""

from dataclasses import dataclass
from unittest.mock import patch

import numpy as np

from clsplat.bench.workloads import city
from clsplat.constants import SPLAT_DEPTH
from clsplat.gaussians import LEARNED
from clsplat.rendering import pipeline
from tests.adversarial.extreme.measure import Error, largest, relative_l2

# of alpha, relative: coordinates of 1000 pixels are rounded to 6e-5 pixels, and the logarithm of
# the alpha of a splat that is all low-pass (sigma 0.55) falls by 6 a pixel at its cutoff, 3.3 sigma
UNDECIDED = 4e-4
STEP = 1e-5  # of the image; where it is smooth the second difference is some UNDECIDED^2 = 1.6e-7


@dataclass(frozen=True)
class CityErrors:
    """Error of the image and of each gradient; compared: share of the pixels; unsorted: share of
    the pixels that are off by more than 1e-4 where each build has its own order."""

    image: Error
    gradients: dict[str, Error]
    compared: float
    unsorted: float


class CityRun:
    """One view of rows float64 (field name -> [N, ...]) of a city, rendered; image: float64."""

    def __init__(self, device, rows, camera):
        self.device = device
        self.renderer = pipeline.Renderer(device, sh_degree=3, near=0.01)
        self.rows = {name: device.upload(values) for name, values in rows.items()}
        self.camera = self.renderer.pack(camera)
        self.frame = self.renderer.render(
            self.rows, self.camera, camera.width, camera.height, sh_degree=3)
        self.image = self.frame.image.download().astype(np.float64)

    def culled(self):
        """Which gaussians are visible, as `cull` returns it."""
        return [values.download() for values in pipeline.cull(
            self.device, self.rows, self.camera, (("SH_REST", 15), ("ANTIALIASED", 0)))]

    def depths(self):
        """The depths by which the splats are ordered, float32[V]."""
        return self.frame.splats.download()[:, SPLAT_DEPTH].astype(np.float32)

    def gradients(self, cotangent):
        """By field name, as arrays like the rows, zero where a gaussian was not visible."""
        found = self.renderer.adjoint(self.rows, self.frame, self.device.upload(cotangent))
        result = {}
        for field in LEARNED:
            result[field.name] = np.zeros(self.rows[field.name].shape)
            result[field.name][self.frame.visible.download()] = found.fields[field.name].download()
        return result


def measure_city(single, double, count):
    """CityErrors of one view of `count` gaussians on the device `single` against `double`."""
    gaussians, (camera, *_) = city(count, (1024, 768))
    rows = {name: values.astype(np.float64) for name, values in gaussians.rows.items()}
    run, alone = CityRun(single, rows, camera), CityRun(double, rows, camera)
    found, depths, project = run.culled(), run.depths(), pipeline.project

    def as_single(device, *_):
        return [device.upload(values) for values in found]

    def in_that_order(device, *arguments):
        splats, _ = project(device, *arguments)
        rows = splats.download()
        rows[:, SPLAT_DEPTH] = depths
        return device.upload(rows), device.upload(depths.view(np.uint32))

    with (patch.object(pipeline, "cull", as_single),
          patch.object(pipeline, "project", in_that_order)):
        expected = CityRun(double, rows, camera)
        more, less = (CityRun(double, with_opacities(rows, factor), camera).image
                      for factor in (1 + UNDECIDED, 1 - UNDECIDED))
    undecided = (np.abs(more - 2 * expected.image + less) > STEP).any(0)
    cotangent = np.where(undecided, 0, np.random.default_rng(0).normal(size=run.image.shape))
    gradients = run.gradients(cotangent)
    return CityErrors(
        largest(np.where(undecided, expected.image, run.image), expected.image),
        {name: relative_l2(gradients[name], values)
         for name, values in expected.gradients(cotangent).items()},
        1 - undecided.mean(), (np.abs(alone.image - run.image) > 1e-4).any(0).mean())


def with_opacities(rows, factor):
    """The rows with all opacities times `factor`."""
    opacity = np.minimum(factor / (1 + np.exp(-rows["opacity_logits"])), 1 - 1e-12)
    return {**rows, "opacity_logits": np.log(opacity / (1 - opacity))}
