"""Whether the scene frequency has converged at a level: three tests of its samples.

`paper` (Xue et al. 2026, eq. 8): the last difference a step is below k mean(1/d). `release`, their
code: a parabola through the last samples is flat beside the steepest moment of the level.
`robust`, ours: the median of the last differences a step is below a share of the frequency itself,
because the initial cloud's 1/d says little once growth has refined it many times over.
"""

import math
from dataclasses import dataclass
from statistics import median

MEDIAN_OF = 3  # differences: one outlier among them decides nothing
WINDOW = 6  # samples of the release's parabola
SLOPE_SHARE, CURVATURE_SHARE = 0.05, 0.1  # of the level's steepest slope (release)


@dataclass(frozen=True)
class Verdict:
    """slope and threshold: frequency a step; slope is None where there are too few samples."""

    slope: float | None
    threshold: float
    converged: bool


def judge(test, samples, rate, inverse_distance):
    """The Verdict on samples [(iteration, frequency), ...] of one level, oldest first.

    test: "robust", "paper" or "release"; rate: k, a step; inverse_distance: mean(1/d) of the
    initial cloud, 1 / world unit, which only `paper` uses. A sample that is not finite counts as
    none.
    """
    samples = [sample for sample in samples if math.isfinite(sample[1])]
    return {"robust": _robust, "paper": _paper, "release": _release}[test](
        samples, rate, inverse_distance)


def _differences(samples):
    """Frequency a step between neighbouring samples."""
    return [(after - before) / (end - begin)
            for (begin, before), (end, after) in zip(samples, samples[1:])]


def _robust(samples, rate, _):
    threshold = rate * samples[-1][1] if samples else 0.0
    if len(samples) <= MEDIAN_OF:
        return Verdict(None, threshold, False)
    slope = median(_differences(samples)[-MEDIAN_OF:])
    return Verdict(slope, threshold, slope < threshold)


def _paper(samples, rate, inverse_distance):
    threshold = rate * inverse_distance
    if len(samples) < 2:
        return Verdict(None, threshold, False)
    slope = _differences(samples)[-1]
    return Verdict(slope, threshold, slope < threshold)


def _release(samples, rate, _):
    if len(samples) < WINDOW:
        return Verdict(None, 0.0, False)
    values = [value for _, value in samples]
    spacing = (samples[-1][0] - samples[0][0]) / (len(samples) - 1)
    fits = [_end_of_parabola(values[end - WINDOW:end])
            for end in range(WINDOW, len(values) + 1)]
    slope, curvature = fits[-1]
    steepest = max(s for s, _ in fits)
    # of a constant frequency nothing but rounding would decide
    latest = values[-WINDOW:]
    flat = max(latest) - min(latest) <= 1e-9 * abs(values[-1])
    converged = flat or (slope >= 0 and slope < SLOPE_SHARE * steepest
                         and curvature <= CURVATURE_SHARE * steepest)
    return Verdict(slope / spacing, SLOPE_SHARE * steepest / spacing, bool(converged))


def _end_of_parabola(values):
    """(slope, curvature) a sample at the last of evenly spaced values, by least squares.

    The parabola is a sum of orthogonal polynomials: 1, t and t^2 - mean(t^2), t = 0 in the middle.
    """
    half = (len(values) - 1) / 2
    places = [number - half for number in range(len(values))]
    squares = [t * t for t in places]
    mean = sum(squares) / len(squares)
    slope = sum(t * y for t, y in zip(places, values)) / sum(squares)
    bend = (sum((s - mean) * y for s, y in zip(squares, values))
            / sum((s - mean) ** 2 for s in squares))
    return slope + 2 * bend * half, 2 * bend
