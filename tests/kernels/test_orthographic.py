"""What maps are drawn with: cameras with parallel rays, and the depth at which half is covered."""

import numpy as np
import pytest

from tests import cases
from tests.checks import close
from tests.kernels import chain
from tests.reference.blend import blend, fragile_pixels
from tests.reference.project import project
from tests.reference.ray_depth import ray_depth
from tests.rendering.test_slabs import downloaded, faint, in_slabs

CHOICES = dict(orthographic=True, depth_percent=50)


def flat(case):
    """The case with an orthographic camera that shows about the same."""
    camera = case["camera"]
    depths = case["rows"]["positions"] @ camera["rotation"][2] + camera["translation"][2]
    scale = float(np.float32(1 / np.median(depths)))
    case["camera"] = {**camera, "fx": camera["fx"] * scale, "fy": camera["fy"] * scale, "orthographic": True}
    return case


@pytest.mark.parametrize("percent", [50, 90])
@pytest.mark.parametrize("name", ["plain", "ragged", "needles", "giants"])
@pytest.mark.one_in(3)
def test_image_and_depth_at_a_share_of_the_light(device, name, percent):
    case = flat(cases.gaussians(name))
    splats = project(case["rows"], case["camera"], case["degree"], case["near"])
    order, size = chain.depth_order(splats), chain.size_of(case)
    fragile = fragile_pixels(splats, order, *size)
    numbered = {**splats, "depths": np.arange(1, len(splats["depths"]) + 1)}
    image, left, number = blend(numbered, order, *size, case["background"], with_depth=True, depth_at=percent / 100)
    depth = ray_depth(case["rows"], case["camera"], number.astype(int), case["near"])
    _, _, frame = chain.render(device, case, with_depth=True, **{**CHOICES, "depth_percent": percent})
    assert sorted(frame.visible.download()) == sorted(order) and len(order) > 5
    precision = chain.precision_of(device)
    close(np.where(fragile, image, frame.image.download()), image, precision, f"{name}: image")
    fragile |= abs(left - percent / 100) < 1e-4  # another splat may be the one at the threshold
    close(np.where(fragile, depth, frame.blended.depth.download()), depth, precision, f"{name}: depth")
    assert (frame.blended.transmittance.download() < 0.5).any()


@pytest.mark.parametrize("name", ["ragged", "giants"])
def test_slabs_show_the_same(float_device, name):
    case = flat(faint(name))
    _, _, whole = chain.render(float_device, case, with_depth=True, **CHOICES)
    expected = downloaded(whole)
    drawn = len(whole.visible)
    for limit in (drawn, -(-drawn // 3)):
        image, depth, left, slabs = in_slabs(float_device, case, limit, **CHOICES)
        assert slabs == -(-drawn // limit)
        for got, target in ((image, expected[0]), (left, expected[2])):
            assert abs(got - target).max() <= 2e-6 * (1 + abs(target).max())
        # every pixel stays lighter than one half: its depth is that of the last splat
        decided = (expected[2] > 0.5) | (slabs == 1)
        assert np.array_equal(depth[decided], expected[1][decided])


def test_a_renderer_refuses_the_other_kind_of_camera_and_an_adjoint(item_device):
    case = cases.gaussians("one")
    renderer, rows, frame = chain.render(item_device, flat(cases.gaussians("one")), **CHOICES)
    with pytest.raises(ValueError, match="orthographic"):
        renderer.pack(chain.camera_of(case))
    with pytest.raises(ValueError, match="orthographic"):
        chain.renderer_of(item_device, case).pack(chain.camera_of(flat(case)))
    with pytest.raises(ValueError, match="no adjoint"):
        renderer.adjoint(rows, frame, frame.blended.image)
