"""The reference's random numbers and steps, against what the paper says of them."""

import numpy as np
import pytest

from tests.reference.noise import gate, hash_of, noise, normal_numbers


def test_the_hash_is_that_of_the_paper():
    """By whole numbers of any size, modulo 2^32, as Jarzynski and Olano write it."""

    def by_hand(*v):
        x, y, z, w = ((each * 1664525 + 1013904223) % 2**32 for each in v)
        for last in (False, True):
            x = (x + y * w) % 2**32
            y = (y + z * x) % 2**32
            z = (z + x * y) % 2**32
            w = (w + y * z) % 2**32
            if not last:
                x, y, z, w = (each ^ each >> 16 for each in (x, y, z, w))
        return [x, y, z, w]

    keys = np.random.default_rng(0).integers(0, 2**32, (50, 4)).astype(np.uint32)
    assert hash_of(keys).tolist() == [by_hand(*key) for key in keys.tolist()]


@pytest.mark.parametrize("now, seed", [(1, 0), (30000, 2**32 - 1)])
def test_the_numbers_are_normal_and_independent(now, seed):
    numbers, following = normal_numbers(200_000, now, seed), normal_numbers(200_000, now + 1, seed)
    assert abs(numbers.mean(axis=0)).max() < 0.01 and abs(numbers).max() < 5.8
    assert np.abs(np.cov(numbers.T) - np.eye(3)).max() < 0.01
    assert abs((numbers**4).mean(axis=0) - 3).max() < 0.06
    assert abs((numbers * following).mean(axis=0)).max() < 0.01
    assert abs((numbers[1:] * numbers[:-1]).mean(axis=0)).max() < 0.01


def test_the_gate_opens_at_the_opacity_of_dead_gaussians():
    logit = np.log(0.005 / 0.995)
    assert gate(np.array(logit)) == pytest.approx(0.5)
    assert gate(np.array([-30.0, logit + 3.2])) == pytest.approx([0.6225, 2.82e-5], rel=0.01)


def test_steps_lie_along_the_gaussian():
    """With the covariance of its covariance: Sigma Sigma^T, for a needle turned by 90 degrees."""
    count = 100_000
    rows = {
        "positions": np.ones((count, 3)),
        "opacity_logits": np.full(count, -20.0),
        "quaternions": np.tile([1.0, 0, 0, 1.0], (count, 1)),
        "log_scales": np.tile(np.log([0.2, 0.05, 0.1]), (count, 1)),
    }
    moved = noise(rows, 2.0, 5, 0, np.zeros(count, bool)) - 1
    spread = 2.0 * gate(np.array(-20.0)) * np.array([0.05, 0.2, 0.1]) ** 2
    assert moved.std(axis=0) == pytest.approx(spread, rel=0.02)
