"""Curves of scores: points, values between them, when a level is reached, bands and spreads."""

import numpy as np
import pytest

from clsplat.report import scores

LINE = (np.array([1.0, 3.0, 5.0]), np.array([10.0, 20.0, 16.0]))
NOTHING = (np.zeros(0), np.zeros(0))


def test_a_curve_keeps_points_with_both_numbers():
    records = [
        {"event": "eval", "t": 1, "v": 2},
        {"event": "step", "t": 2, "v": 3},
        {"event": "eval", "t": 3, "v": None},
        {"event": "eval", "t": 4},
        {"event": "eval", "t": 0, "v": 0},
    ]
    assert [list(part) for part in scores.curve(records, "t", "v", "eval")] == [[1, 0], [2, 0]]
    assert [list(part) for part in scores.curve(records, "t", "v")] == [[1, 2, 0], [2, 3, 0]]
    assert [len(part) for part in scores.curve([], "t", "v")] == [0, 0]


def test_values_are_linear_between_points_and_unknown_outside():
    assert [scores.value_at(LINE, when) for when in (1, 2, 3, 4.5, 5)] == [10, 15, 20, 17, 16]
    assert [scores.value_at(LINE, when) for when in (0.9, 5.1)] == [None, None]
    assert scores.value_at(NOTHING, 1) is None


@pytest.mark.parametrize(
    "level, answer", [(12.5, (1.5, False)), (20, (3.0, False)), (10, (1.0, True)), (7, (1.0, True)), (20.1, None)]
)
def test_when_a_level_is_reached(level, answer):
    assert scores.reached(LINE, level) == answer
    assert scores.reached(NOTHING, level) is None


def test_band():
    other = (np.array([2.0, 6.0]), np.array([11.0, 31.0]))
    x, mean, low, high = scores.band([LINE, other, NOTHING])
    assert list(x) == [2, 3, 5]  # where both are known, at the points of either
    assert list(low) == [11, 16, 16] and list(high) == [15, 20, 26]
    assert list(mean) == [13, 18, 21]
    assert all(map(np.array_equal, scores.band([LINE])[:2], LINE))
    for apart in ([], [NOTHING], [LINE, (np.array([6.0]), np.array([1.0]))]):
        assert [len(part) for part in scores.band(apart)] == [0] * 4


def test_spread():
    assert scores.spread([1.0, None, 3.0]) == (2.0, pytest.approx(2**0.5))
    assert scores.spread([4.0]) == (4.0, None) and scores.spread([None]) == (None, None)
