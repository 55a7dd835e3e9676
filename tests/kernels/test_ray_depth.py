"""Depths along rays: numbers of splats, and the depths that they become."""

import numpy as np
import pytest

from clsplat.constants import SPLAT_DEPTH, SPLAT_REALS
from clsplat.rendering import pipeline
from clsplat.rendering.ray_depth import number_splats, ray_depth
from tests import cases
from tests.checks import close
from tests.kernels import chain
from tests.kernels.test_orthographic import flat
from tests.reference.project import project
from tests.reference.ray_depth import ray_depth as reference


def resolved(device, case, seen, numbers):
    """The depths of numbers of these gaussians."""
    orthographic = case["camera"].get("orthographic", False)
    renderer = chain.renderer_of(device, case, orthographic=orthographic)
    depth = device.upload(numbers.astype(np.float64))
    ray_depth(
        device,
        chain.upload_rows(device, case["rows"]),
        device.upload(seen.astype(np.uint32)),
        renderer.pack(chain.camera_of(case)),
        depth,
        renderer._project_defines,
    )
    return depth.download()


@pytest.mark.oclgrind
@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("name", ["plain", "ragged", "needles", "giants", "one"])
def test_depths_of_pixels(device, name, orthographic):
    """Of random gaussians that the view shows, near their means and far away."""
    case = cases.gaussians(name)
    case = flat(case) if orthographic else case
    splats = project(case["rows"], case["camera"], 0, case["near"])
    seen = np.flatnonzero(splats["visible"])
    numbers = np.random.default_rng(0).integers(0, len(seen) + 1, chain.size_of(case)[::-1])
    found = resolved(device, case, seen, numbers)
    rows = np.concatenate([[0], seen + 1])[numbers]
    expected = reference(case["rows"], case["camera"], rows, case["near"])
    # far from its mean, a small slope is a large number of pixels: a share of the way counts
    reach = np.abs(expected - np.concatenate([[0], splats["depths"]])[rows])
    scale = np.maximum(np.abs(expected), reach).clip(1e-3)
    close(found / scale, expected / scale, chain.precision_of(device), name)
    assert (found[numbers == 0] == 0).all() and (numbers == 0).any()
    assert len(seen) == 1 or (reach > 1e-3 * expected).any()


@pytest.mark.parametrize("count", [1, 127, 128, 129, 1000])
def test_numbers_take_the_place_of_depths_in_a_copy(device, count):
    own = device.upload(np.random.default_rng(0).uniform(1, 2, (count, SPLAT_REALS)))
    before = own.download()
    found = number_splats(device, own, (("ANTIALIASED", 0),)).download()
    assert np.array_equal(own.download(), before)
    before[:, SPLAT_DEPTH] = np.arange(1, count + 1)
    assert np.array_equal(found, before)


def test_what_is_not_finite_has_the_depth_of_its_centre(device):
    case = cases.gaussians("plain")
    seen = np.flatnonzero(project(case["rows"], case["camera"], 0, case["near"])["visible"])[:2]
    case["rows"]["log_scales"][seen[0], 0] = 1e4
    numbers = np.array([[1, 2, 0]])
    found = resolved(device, case, seen, numbers)
    depths = case["rows"]["positions"] @ case["camera"]["rotation"][2] + (case["camera"]["translation"][2])
    close(found[0, 0], depths[seen[0]], chain.precision_of(device), "centre")
    assert np.isfinite(found).all()


def test_more_splats_than_numbers_keep_the_depths_of_their_centres(float_device, monkeypatch):
    case = cases.gaussians("plain")
    _, _, frame = chain.render(float_device, case, with_depth=True, depth_percent=50)
    monkeypatch.setattr(pipeline, "MOST_NUMBERED", 1)
    _, _, other = chain.render(float_device, case, with_depth=True, depth_percent=50)
    centres = np.concatenate([[0], frame.splats.download()[:, SPLAT_DEPTH]])
    assert np.isin(other.blended.depth.download(), centres).all()
    assert not np.isin(frame.blended.depth.download(), centres).all()
