"""Three tests for whether the scene frequency has converged at a level.

`paper` (Xue et al. 2026, eq. 8): the last difference per step is below k mean(1/d). `release`, the
authors' code: a parabola through the last samples is flat compared with the steepest slope of the
level. `robust`, ours: the median of the last differences per step is below a share of the frequency
itself, because the initial cloud's 1/d says little once growth has refined it many times over.
"""

import math
from collections.abc import Sequence
from statistics import linear_regression, median
from typing import NamedTuple

MEDIAN_OF = 3  # differences, so that a single outlier decides nothing
WINDOW = 6  # samples under the parabola of `release`
SLOPE_SHARE, CURVATURE_SHARE = 0.05, 0.1  # of the level's steepest slope (`release`)
Samples = Sequence[tuple[int, float]]


class Verdict(NamedTuple):
    """A test's result: the growth of the frequency per step (None: too few samples), the slope
    below which it has converged, and whether it has."""

    slope: float | None
    threshold: float
    converged: bool


def judge(test: str, samples: Samples, rate: float, inverse_distance: float) -> Verdict:
    """Test ("robust", "paper" or "release") whether the scene frequency has converged.

    `samples` are (iteration, frequency) of one level, oldest first, and those that are not finite
    are ignored; `rate` is k, per step; `inverse_distance` is mean(1/d), 1 / world unit, for `paper`
    only.
    """
    samples = [sample for sample in samples if math.isfinite(sample[1])]
    if test == "release":
        return _release(samples)
    count, scale = (1, inverse_distance) if test == "paper" else (MEDIAN_OF, samples[-1][1] if samples else 0.0)
    slopes = [(after - before) / (end - begin) for (begin, before), (end, after) in zip(samples, samples[1:])]
    slope = median(slopes[-count:]) if len(slopes) >= count else None
    return Verdict(slope, rate * scale, slope is not None and slope < rate * scale)


def _release(samples: Samples) -> Verdict:
    if len(samples) < WINDOW:
        return Verdict(None, 0.0, False)
    values = [value for _, value in samples]
    spacing = (samples[-1][0] - samples[0][0]) / (len(samples) - 1)
    fits = [_end_of_parabola(values[end - WINDOW : end]) for end in range(WINDOW, len(values) + 1)]
    slope, curvature = fits[-1]
    steepest = max(s for s, _ in fits)
    # with a constant frequency, rounding would decide
    flat = max(values[-WINDOW:]) - min(values[-WINDOW:]) <= 1e-9 * abs(values[-1])
    converged = flat or (0 <= slope < SLOPE_SHARE * steepest and curvature <= CURVATURE_SHARE * steepest)
    return Verdict(slope / spacing, SLOPE_SHARE * steepest / spacing, converged)


def _end_of_parabola(values: Sequence[float]) -> tuple[float, float]:
    """(slope, curvature) per sample at the last of evenly spaced values, by least squares.

    The parabola is a sum of orthogonal polynomials: 1, t and t^2 - mean(t^2), t = 0 in the middle;
    so each coefficient is a regression of its own.
    """
    half = (len(values) - 1) / 2
    places = [number - half for number in range(len(values))]
    slope = linear_regression(places, values).slope
    bend = linear_regression([t * t for t in places], values).slope
    return slope + 2 * bend * half, 2 * bend
