"""The reference blend: against finite differences and against values computed by hand."""

import numpy as np
import pytest

from tests import cases
from tests.checks import adjoint_agrees
from tests.reference.blend import blend, blend_adjoint, fragile_pixels
from tests.reference.project import project

BACKGROUND = np.array([0.3, 0.6, 0.1])


def on_one_pixel(opacities, colours, depths=None):
    """Splats centred on the only pixel of an image, front first, and their order."""
    count = len(opacities)
    depths = np.arange(1.0, count + 1) if depths is None else np.asarray(depths, float)
    return {"means": np.full((count, 2), 0.5), "conics": np.tile([1.0, 0, 1], (count, 1)),
            "opacities": np.asarray(opacities, float), "colours": np.asarray(colours, float),
            "depths": depths}, np.arange(count)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("size", [(48, 40), (7, 5), (1, 1)])
def test_adjoint_agrees_with_differences(size, with_depth, seed):
    splats, order = cases.splats(12, *size, seed=seed, opacity=(0.05, 0.8))
    assert blend(splats, order, *size, BACKGROUND, smooth=True)[1].min() > 2e-4

    def function(point):
        image, transmittance, depth = blend(
            point, order, *size, BACKGROUND, smooth=True, with_depth=with_depth)
        more = {"depth": depth, "transmittance": transmittance} if with_depth else {}
        return {"image": image, **more}

    def adjoint(point, grads):
        return blend_adjoint(point, order, *size, BACKGROUND, grads["image"], grads.get("depth"),
                             grads.get("transmittance"), smooth=True)

    adjoint_agrees(function, adjoint, splats, seed, what=f"blend {size}")


def test_hard_cutoff_and_early_stop_have_the_adjoint_of_what_is_drawn():
    """Away from the thresholds, hard comparisons are constant and differences still hold."""
    case = cases.gaussians("stack")
    splats = project(case["rows"], case["camera"], case["degree"], case["near"])
    order = np.flatnonzero(splats["visible"])[np.argsort(splats["depths"][splats["visible"]])]
    size = case["camera"]["width"], case["camera"]["height"]
    point = {key: splats[key] for key in ("means", "conics", "opacities", "colours", "depths")}
    sure = ~fragile_pixels(point, order, *size, tolerance=1e-2)
    assert 0.3 < sure.mean() < 1
    drawn = blend(point, order, *size, BACKGROUND)
    assert (drawn[1] < 1e-3).any() and (point["opacities"] > 0.99).any()
    adjoint_agrees(
        lambda p: {"image": blend(p, order, *size, BACKGROUND)[0] * sure},
        lambda p, grads: blend_adjoint(p, order, *size, BACKGROUND, grads["image"] * sure),
        point, what="hard blend")


def test_alpha_is_clamped_and_the_clamp_blocks_the_gradient():
    splats, order = on_one_pixel([1.0], [[1, 1, 1]])
    image, transmittance, _ = blend(splats, order, 1, 1, BACKGROUND)
    np.testing.assert_allclose(transmittance, [[0.01]])
    np.testing.assert_allclose(image[:, 0, 0], 0.99 + 0.01 * BACKGROUND)
    grads = blend_adjoint(splats, order, 1, 1, BACKGROUND, np.ones((3, 1, 1)))
    assert grads["opacities"] == 0 and not grads["conics"].any()
    np.testing.assert_allclose(grads["colours"], 0.99)


def test_pixel_stops_before_the_splat_that_would_pass_the_limit():
    """T: 1, 0.01, then 0.0002, then the third would leave 0.00002 and is not drawn."""
    colours = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    splats, order = on_one_pixel([1.0, 0.98, 0.9, 0.1], colours)
    image, transmittance, _ = blend(splats, order, 1, 1, np.zeros(3))
    np.testing.assert_allclose(image[:, 0, 0], [0.99, 0.01 * 0.98, 0])
    np.testing.assert_allclose(transmittance, [[0.0002]])
    grads = blend_adjoint(splats, order, 1, 1, np.zeros(3), np.ones((3, 1, 1)))
    assert not grads["colours"][2:].any() and not grads["opacities"][2:].any()
    np.testing.assert_allclose(grads["opacities"][1], 0.01)


def test_fragile_pixels_are_those_at_a_threshold():
    splats, order = on_one_pixel([1.00005 / 255], [[1, 1, 1]])
    assert fragile_pixels(splats, order, 1, 1).all()
    splats["opacities"][:] = 0.5
    assert not fragile_pixels(splats, order, 1, 1).any()
