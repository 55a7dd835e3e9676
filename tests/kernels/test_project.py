"""Gaussians to splats and the adjoint by themselves: culling, splats, gradients of random sums."""

import numpy as np
import pytest

from clsplat.rendering.project import cull, pack_camera, project, project_adjoint
from tests import cases
from tests.checks import close
from tests.kernels.chain import (
    camera_of,
    close_gradients,
    grads_of_sums,
    precision_of,
    stored_degree,
    upload_rows,
)
from tests.reference import project as reference

ANTIALIASED = ("degree_0", "plain", "needles", "opacities", "specks")
CASES = [(name, False) for name in cases.SCENES] + [(name, True) for name in ANTIALIASED]


class Projected:
    """A case through cull, project and its adjoint; everything downloaded, by row."""

    def __init__(self, device, case, antialiased=False, with_depth=True):
        defines = (("SH_REST", case["rows"]["sh_rest"].shape[1]), ("ANTIALIASED", int(antialiased)))
        rows = upload_rows(device, case["rows"])
        camera = pack_camera(device, camera_of(case), case["near"])
        flags, keys = (a.download() for a in cull(device, rows, camera, defines))
        self.visible, self.keys = np.flatnonzero(flags), keys
        seen = device.upload(self.visible.astype(np.uint32))
        splats = project(device, rows, seen, camera, case["degree"], defines)
        self.splats = splats.download()
        self.sums = cases.single(np.random.default_rng(3).normal(
            size=(len(self.visible), 9 + with_depth)))
        self.skipped = device.zeros(1, np.uint32)
        gradients, self.grad_means, active = project_adjoint(
            device, rows, seen, camera, case["degree"], defines, device.upload(self.sums),
            self.skipped)
        self.active = active.download()
        self.grad_means = self.grad_means.download()
        self.gradients = {}
        for name, values in case["rows"].items():
            self.gradients[name] = np.zeros(values.shape)
            downloaded = gradients[name].download()
            if name == "sh_rest":
                downloaded[:, case["degree"] * (case["degree"] + 2):] = 0
            self.gradients[name][self.visible] = downloaded


def check(device, case, antialiased, what):
    arguments = case["camera"], case["degree"], case["near"]
    expected = reference.project(case["rows"], *arguments, antialiased=antialiased)
    actual = Projected(device, case, antialiased)
    visible, precision = actual.visible, precision_of(device)
    assert np.array_equal(visible, np.flatnonzero(expected["visible"])), f"{what}: visible"
    conics = expected["conics"][visible]
    close(actual.keys[visible].view(np.float32), expected["depths"][visible], "float",
          f"{what}: depth keys")
    parts = {"means": slice(0, 2), "opacities": 2, "cutoffs": 3, "colours": slice(8, 11),
             "depths": 11}
    for name, columns in parts.items():
        close(actual.splats[:, columns], expected[name][visible], precision, f"{what}: {name}")
    close(actual.splats[:, 7], expected["extents"][visible, 1], precision, f"{what}: extents")
    # each conic by its own size: those of needles and specks differ by many orders
    size = np.abs(conics).max(axis=1, keepdims=True)
    close(actual.splats[:, 4:7] / size, conics / size, precision, f"{what}: conics")

    by_splat = grads_of_sums(actual.sums, conics)
    grads = {name: np.zeros((len(expected["visible"]), *values.shape[1:]))
             for name, values in by_splat.items()}
    for name, values in by_splat.items():
        grads[name][visible] = values
    close(actual.grad_means, by_splat["means"], precision, f"{what}: gradient of means")
    close_gradients(
        actual.gradients,
        reference.project_adjoint(case["rows"], *arguments, antialiased=antialiased, grads=grads),
        case, precision, what)
    assert np.array_equal(actual.active, visible) and actual.skipped.last() == 0, what


@pytest.mark.parametrize("name, antialiased", CASES)
def test_splats_and_gradients(device, name, antialiased):
    check(device, cases.gaussians(name), antialiased, name)


@pytest.mark.oclgrind
def test_counts_around_the_group_size(device):
    group = device.group_size
    for count in (0, 1, group - 1, group, group + 1, 3 * group + 7):
        check(device, cases.gaussians("degree_1", count=count), False, f"{count} gaussians")


def test_without_the_depth_sum_nothing_flows_to_depth(device):
    """Nine sums a row instead of ten, read with the right stride."""
    case = cases.gaussians("degree_1", seed=1)
    ten, nine = (Projected(device, case, with_depth=d) for d in (True, False))
    expected = reference.project(case["rows"], case["camera"], case["degree"], case["near"])
    grads = {name: np.zeros((len(expected["visible"]), *values.shape[1:])) for name, values in
             grads_of_sums(nine.sums, expected["conics"][nine.visible]).items()}
    for name, values in grads_of_sums(nine.sums, expected["conics"][nine.visible]).items():
        grads[name][nine.visible] = values
    close_gradients(
        nine.gradients, reference.project_adjoint(
            case["rows"], case["camera"], case["degree"], case["near"], grads=grads),
        case, precision_of(device), "nine sums")
    assert not np.array_equal(ten.gradients["positions"], nine.gradients["positions"])


def test_saturated_opacities_keep_their_gradient(device):
    """1 - opacity is zero in single precision from a logit of 17 on, its derivative is not."""
    case = cases.gaussians("degree_1")
    case["rows"]["opacity_logits"][:] = np.resize([17.0, 25.0, 40.0], 25)
    actual = Projected(device, case)
    logit = case["rows"]["opacity_logits"][actual.visible]
    grad = actual.gradients["opacity_logits"][actual.visible]
    ratio = grad / (actual.sums[:, 3] * np.exp(-logit))
    assert np.allclose(ratio, 1, rtol=1e-4)


def test_bands_that_are_not_active_do_not_count(device):
    case = cases.gaussians("lower_degree_active")
    plain = Projected(device, case)
    case["rows"]["sh_rest"][:, 3:] = 1e3
    changed = Projected(device, case)
    assert np.array_equal(plain.splats, changed.splats)
    assert stored_degree(case) == 3 and case["degree"] == 1
    for name, values in plain.gradients.items():
        assert np.array_equal(values, changed.gradients[name]), name
