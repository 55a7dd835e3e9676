"""The reference blend: against finite differences and against values computed by hand."""

import numpy as np
import pytest

from tests import cases
from tests.checks import adjoint_agrees
from tests.reference.blend import blend, blend_adjoint, fragile_pixels
from tests.reference.project import project, project_adjoint

BACKGROUND = np.array([0.3, 0.6, 0.1])


def on_one_pixel(opacities, colours, depths=None):
    """Splats centred on the only pixel of an image, front first, and their order."""
    count = len(opacities)
    depths = np.arange(1.0, count + 1) if depths is None else np.asarray(depths, float)
    return {
        "means": np.full((count, 2), 0.5),
        "conics": np.tile([1.0, 0, 1], (count, 1)),
        "opacities": np.asarray(opacities, float),
        "colours": np.asarray(colours, float),
        "depths": depths,
    }, np.arange(count)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("size", [(48, 40), (7, 5), (1, 1)])
def test_adjoint_agrees_with_differences(size, with_depth, seed):
    splats, order = cases.splats(12, *size, seed=seed, opacity=(0.05, 0.8))
    assert blend(splats, order, *size, BACKGROUND, smooth=True)[1].min() > 2e-4

    def function(point):
        image, transmittance, depth = blend(point, order, *size, BACKGROUND, smooth=True, with_depth=with_depth)
        more = {"depth": depth, "transmittance": transmittance} if with_depth else {}
        return {"image": image, **more}

    def adjoint(point, grads):
        return blend_adjoint(
            point, order, *size, BACKGROUND, grads["image"], grads.get("depth"), grads.get("transmittance"), smooth=True
        )

    adjoint_agrees(function, adjoint, splats, seed, what=f"blend {size}")


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", ["plain", "ragged", "one_tile", "less_than_a_tile"])
def test_chain_of_project_and_blend_agrees_with_differences(name, antialiased):
    case = cases.gaussians(name, seed=2, count=14)
    camera, size = case["camera"], (case["camera"]["width"], case["camera"]["height"])
    arguments = camera, case["degree"], case["near"]
    first = project(case["rows"], *arguments, antialiased=antialiased)
    order = np.argsort(first["depths"], kind="stable")
    order = order[first["visible"][order]]

    def function(rows):
        splats = project(rows, *arguments, antialiased=antialiased)
        image, transmittance, depth = blend(splats, order, *size, BACKGROUND, True, True)
        assert transmittance.min() > 2e-4
        return {"image": image, "depth": depth, "transmittance": transmittance}

    def adjoint(rows, grads):
        splats = project(rows, *arguments, antialiased=antialiased)
        by_splat = blend_adjoint(
            splats, order, *size, BACKGROUND, grads["image"], grads["depth"], grads["transmittance"], smooth=True
        )
        return project_adjoint(rows, *arguments, antialiased=antialiased, grads=by_splat)

    adjoint_agrees(function, adjoint, case["rows"], what=f"chain {name}")


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
        point,
        what="hard blend",
    )


def test_two_splats_by_hand():
    splats, order = on_one_pixel([0.5, 0.8], [[1, 0, 0], [0, 1, 0]], depths=[2, 5])
    image, transmittance, depth = blend(splats, order, 1, 1, BACKGROUND, with_depth=True)
    np.testing.assert_allclose(image[:, 0, 0], [0.5 + 0.03, 0.4 + 0.06, 0.01])
    np.testing.assert_allclose(transmittance, [[0.1]])
    np.testing.assert_allclose(depth, [[0.5 * 2 + 0.4 * 5]])
    assert not blend(splats, order, 1, 1, BACKGROUND)[2].any()
    swapped = blend(splats, order[::-1], 1, 1, BACKGROUND)[0]
    np.testing.assert_allclose(swapped[:, 0, 0], [0.1 + 0.03, 0.8 + 0.06, 0.01])


def test_falloff_by_hand():
    """Pixel (row 1, column 2) has its centre at x 2.5, y 1.5."""
    splats, order = on_one_pixel([0.9], [[1, 1, 1]])
    splats["means"], splats["conics"] = np.array([[2.0, 0.5]]), np.array([[0.2, 0.1, 0.4]])
    image = blend(splats, order, 3, 2, np.zeros(3))[0]
    q = 0.2 * 0.25 + 2 * 0.1 * 0.5 * 1 + 0.4 * 1
    np.testing.assert_allclose(image[:, 1, 2], 0.9 * np.exp(-q / 2))


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


def test_faint_splats_are_skipped():
    splats, order = on_one_pixel([0.99 / 255, 1.01 / 255], [[1, 0, 0], [0, 1, 0]])
    image = blend(splats, order, 1, 1, np.zeros(3))[0]
    np.testing.assert_allclose(image[:, 0, 0], [0, 1.01 / 255, 0])
    assert blend(splats, order, 1, 1, np.zeros(3), smooth=True)[0][1] < 1e-3 / 255


def test_smooth_equals_hard_well_above_the_cutoff():
    splats, order = on_one_pixel([2.01 / 255, 0.5, 0.9], np.eye(3))
    hard, smooth = (blend(splats, order, 1, 1, BACKGROUND, smooth)[0] for smooth in (False, True))
    np.testing.assert_array_equal(hard, smooth)


def test_weights_and_transmittance_sum_to_one():
    splats, order = cases.splats(40, 33, 17, opacity=(0.5, 1.0))
    splats["colours"][:] = 1
    np.testing.assert_allclose(blend(splats, order, 33, 17, np.ones(3))[0], 1, rtol=1e-12)


def test_fragile_pixels_are_those_at_a_threshold():
    splats, order = on_one_pixel([1.00005 / 255], [[1, 1, 1]])
    assert fragile_pixels(splats, order, 1, 1).all()
    splats["opacities"][:] = 0.5
    assert not fragile_pixels(splats, order, 1, 1).any()


def test_no_splats_leave_the_background():
    splats, order = cases.splats(0, 7, 5)
    image, transmittance, depth = blend(splats, order, 7, 5, BACKGROUND, with_depth=True)
    assert (image == BACKGROUND[:, None, None]).all() and (transmittance == 1).all()
    assert not depth.any()
