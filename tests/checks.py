"""How exactly results must agree; the only place that holds these numbers."""

import numpy as np

RELATIVE = {"float": 1e-4, "double": 1e-10}
FLOOR = 0.1  # of the relative tolerance, times the largest expected value: what rounding may leave


def close(actual, expected, precision, what):
    """Assert |actual - expected| <= relative x (|expected| + floor x largest |expected|).

    precision: 'float' or 'double'. Values that are not finite must be the same. The message names
    `what` and the worst element.
    """
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    assert actual.shape == expected.shape, f"{what}: shape {actual.shape}, not {expected.shape}"
    finite = np.isfinite(expected)
    strange = np.argwhere(~(np.isfinite(actual) & finite) & ~_same(actual, expected))
    assert not len(strange), (
        f"{what}: {len(strange)} of {actual.size} not finite or wrongly finite, the first at "
        f"{_index(strange[0])}: {_at(actual, strange[0])}, not {_at(expected, strange[0])}"
    )
    if not finite.any():
        return
    largest = np.abs(expected[finite]).max()
    allowed = RELATIVE[precision] * (np.abs(np.where(finite, expected, 0)) + FLOOR * largest)
    error = np.abs(np.where(finite, actual, 0) - np.where(finite, expected, 0))
    bad = error > allowed
    if bad.any():
        tiny = np.finfo(np.float64).tiny
        worst = np.unravel_index(np.argmax(np.where(bad, error / np.maximum(allowed, tiny), 0)), error.shape)
        raise AssertionError(
            f"{what} ({precision}): {bad.sum()} of {error.size} differ, the worst at "
            f"{_index(worst)}: {actual[worst]:.9g}, not {expected[worst]:.9g}, off by "
            f"{error[worst]:.3g} where {allowed[worst]:.3g} is allowed"
        )


def adjoint_agrees(function, adjoint, point, seed=0, relative=1e-6, step=1e-6, what="adjoint"):
    """Assert that `adjoint` is the transposed derivative of `function` at `point`.

    function(point) -> dict of arrays; adjoint(point, cotangents) -> dict of gradients like point,
    with cotangents like the function's result. For each array of the point, the derivative of the
    randomly weighted result along a random direction, by central differences of fourth order, is
    compared with the gradient along it, relative to the size of the terms that sum up to it.
    """
    rng = np.random.default_rng(seed)
    cotangents = {name: rng.normal(size=np.shape(value)) for name, value in function(point).items()}
    grads = adjoint(point, cotangents)

    def weighted(name, direction, distance):
        result = function({**point, name: point[name] + distance * direction})
        return sum(np.sum(result[key] * weight) for key, weight in cotangents.items())

    for name, value in point.items():
        # each element by its own size: a step that is small for one row may be large for another
        scale = np.abs(value) + (0.01 * np.sqrt(np.mean(np.square(value))) if np.any(value) else 1)
        direction = scale * rng.normal(size=np.shape(value))
        near, far = (weighted(name, direction, k * step) - weighted(name, direction, -k * step) for k in (1, 2))
        by_difference = (8 * near - far) / (12 * step)
        terms = grads[name] * direction
        by_adjoint = np.sum(terms)
        size = max(abs(by_difference), abs(by_adjoint), np.sqrt(np.sum(terms**2)))
        assert abs(by_difference - by_adjoint) <= relative * size, (
            f"{what}, seed {seed}: along {name} the difference quotient is {by_difference:.12g}, "
            f"the adjoint gives {by_adjoint:.12g} (relative to {size:.3g}: "
            f"{abs(by_difference - by_adjoint) / size:.2g})"
        )


def _same(actual, expected):
    return (actual == expected) | (np.isnan(actual) & np.isnan(expected))


def _index(index):
    return "[" + ", ".join(str(int(i)) for i in index) + "]"


def _at(values, index):
    return values[tuple(index)]
