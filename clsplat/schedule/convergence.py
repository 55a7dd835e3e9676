"""Whether the scene frequency has converged at a level: three tests of its samples.

`paper` (Xue et al. 2026, eq. 8): the last difference a step is below k mean(1/d). `release`, their
code: a parabola through the last samples is flat beside the steepest moment of the level.
`robust`, ours: the median of the last differences a step is below a share of the frequency itself,
because the initial cloud's 1/d says little once growth has refined it many times over.
"""

from dataclasses import dataclass

import numpy as np

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
    samples = [sample for sample in samples if np.isfinite(sample[1])]
    return {"robust": _robust, "paper": _paper, "release": _release}[test](
        samples, rate, inverse_distance)


def _differences(samples):
    """Frequency a step between neighbouring samples."""
    iterations, values = np.array(samples, np.float64).T
    return np.diff(values) / np.diff(iterations)


def _robust(samples, rate, _):
    threshold = rate * samples[-1][1] if samples else 0.0
    if len(samples) <= MEDIAN_OF:
        return Verdict(None, threshold, False)
    slope = float(np.median(_differences(samples)[-MEDIAN_OF:]))
    return Verdict(slope, threshold, slope < threshold)


def _paper(samples, rate, inverse_distance):
    threshold = rate * inverse_distance
    if len(samples) < 2:
        return Verdict(None, threshold, False)
    slope = float(_differences(samples)[-1])
    return Verdict(slope, threshold, slope < threshold)


def _release(samples, rate, _):
    if len(samples) < WINDOW:
        return Verdict(None, 0.0, False)
    iterations, values = np.array(samples, np.float64).T
    spacing = (iterations[-1] - iterations[0]) / (len(samples) - 1)
    fits = [_end_of_parabola(values[end - WINDOW:end])
            for end in range(WINDOW, len(values) + 1)]
    slope, curvature = fits[-1]
    steepest = max(s for s, _ in fits)
    # of a constant frequency nothing but rounding would decide
    flat = np.ptp(values[-WINDOW:]) <= 1e-9 * abs(values[-1])
    converged = flat or (slope >= 0 and slope < SLOPE_SHARE * steepest
                         and curvature <= CURVATURE_SHARE * steepest)
    return Verdict(slope / spacing, SLOPE_SHARE * steepest / spacing, bool(converged))


def _end_of_parabola(values):
    """(slope, curvature) a sample at the last of evenly spaced values, by least squares."""
    a, b, _ = np.polyfit(np.arange(len(values)), values, 2)
    return 2 * a * (len(values) - 1) + b, 2 * a
