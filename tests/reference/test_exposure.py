"""The reference exposure against differences, and by hand."""

import numpy as np
import pytest

from tests import cases
from tests.checks import adjoint_agrees
from tests.reference import exposure

LENS = np.array([-0.2, 0.1, -0.15, 0.8])


def a_transform(seed):
    return np.eye(3, 4) + np.random.default_rng(seed).normal(0, 0.2, (3, 4))


@pytest.mark.parametrize("size", cases.IMAGE_SIZES, ids=str)
def test_adjoint_agrees_with_differences(size):
    u = np.random.default_rng(1).uniform(0, 1, size[::-1])

    def forward(point):
        return {"result": exposure.apply(point["transform"], point["image"], [*point["terms"], 1], u)}

    def adjoint(point, grads):
        return dict(
            zip(
                ("image", "transform", "terms"),
                exposure.apply_adjoint(point["transform"], point["image"], grads["result"], [*point["terms"], 1], u),
            )
        )

    adjoint_agrees(
        forward,
        adjoint,
        {"transform": a_transform(0), "image": cases.images(*size)[0], "terms": LENS[:3]},
        what=f"{size}",
    )


def test_gain_is_one_on_the_axis_and_the_sum_of_its_terms_in_the_corner():
    assert exposure.gain(LENS, np.zeros((1, 1))) == 1
    assert exposure.gain(LENS, np.ones((1, 1))) == pytest.approx(0.75)


def test_a_lens_steps_as_a_transform_does_and_keeps_its_scale():
    lenses, zero = np.stack([LENS, 2 * LENS]), np.zeros((2, 3))
    moved, first, _, counts = exposure.lens_step(
        lenses, zero, zero, np.zeros(2, int), 1, np.array([1.0, -2, 3]), 0.01, 0
    )
    np.testing.assert_allclose(moved[1] - lenses[1], [-0.01, 0.01, -0.01, 0])
    np.testing.assert_array_equal(moved[0], lenses[0])
    np.testing.assert_allclose(first[1], [0.1, -0.2, 0.3])
    assert counts.tolist() == [0, 1]


def test_lens_penalty_agrees_with_differences():
    adjoint_agrees(
        lambda point: {"penalty": np.array(exposure.lens_penalty(point["lens"], 0.3)[0])},
        lambda point, grads: {"lens": np.append(exposure.lens_penalty(point["lens"], 0.3)[1] * grads["penalty"], 0)},
        {"lens": LENS},
        what="penalty",
    )


def test_penalty_agrees_with_differences():
    adjoint_agrees(
        lambda point: {"penalty": np.array(exposure.penalty(point["transform"], 0.3)[0])},
        lambda point, grads: {"transform": exposure.penalty(point["transform"], 0.3)[1] * grads["penalty"]},
        {"transform": a_transform(1)},
        what="penalty",
    )
    assert exposure.penalty(np.eye(3, 4), 1)[0] == 0
    assert exposure.penalty(np.eye(3, 4) + 0.5, 2)[0] == pytest.approx(0.5)


def test_identity_changes_nothing_and_entries_stand_row_by_row():
    image = cases.images(7, 5)[0]
    np.testing.assert_allclose(exposure.apply(np.eye(3, 4), image), image, atol=1e-14)
    transform = np.zeros((3, 4))
    transform[1, 2], transform[1, 3] = 2, 0.25  # green is made of blue
    result = exposure.apply(transform, image)
    np.testing.assert_allclose(result[1], 2 * image[2] + 0.25)
    assert not result[[0, 2]].any()


def test_a_step_goes_against_the_gradient_of_its_own_view():
    transforms, zero = np.tile(np.eye(3, 4), (3, 1, 1)), np.zeros((3, 3, 4))
    grad = np.random.default_rng(2).normal(size=(3, 4))
    moved, first, second, counts = exposure.step(transforms, zero, zero, np.zeros(3, int), 1, grad, 0.01, 0)
    np.testing.assert_allclose(moved[1], np.eye(3, 4) - 0.01 * np.sign(grad))
    np.testing.assert_allclose(first[1], 0.1 * grad)
    np.testing.assert_array_equal(moved[[0, 2]], transforms[[0, 2]])
    assert counts.tolist() == [0, 1, 0]
    assert not first[[0, 2]].any() and not second[[0, 2]].any()
    grad[2, 3] = np.nan
    again = exposure.step(moved, first, second, counts, 1, grad, 0.01, 0)
    assert all(a is b for a, b in zip(again, (moved, first, second, counts)))


def test_the_pull_alone_leads_towards_the_identity():
    state = a_transform(3)[None], np.zeros((1, 3, 4)), np.zeros((1, 3, 4)), np.zeros(1, int)
    values = []
    for _ in range(50):
        values.append(exposure.penalty(state[0][0], 0.01)[0])
        state = exposure.step(*state, 0, np.zeros((3, 4)), 1e-3, 0.01)
    assert (np.diff(values) < 0).all() and values[-1] < 0.8 * values[0]


def test_between_takes_one_views_colours_to_anothers():
    image, first, second = cases.images(9, 4)[0], a_transform(4), a_transform(5)
    np.testing.assert_allclose(
        exposure.apply(exposure.between(first, second), exposure.apply(second, image)), exposure.apply(first, image)
    )
    np.testing.assert_allclose(exposure.between(first, first), np.eye(3, 4), atol=1e-14)
