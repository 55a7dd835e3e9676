"""Two tests for whether the scene frequency has converged at a level.

`paper` (Xue et al. 2026, eq. 8): the last difference per step is below k mean(1/d). `robust`, ours:
the median of the last differences per step is below a share of the frequency itself, because the
initial cloud's 1/d says little once growth has refined it many times over.
"""

import math
from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

MEDIAN_OF = 3  # differences, so that a single outlier decides nothing


class Verdict(NamedTuple):
    """A test's result: the growth of the frequency per step (None: too few samples), the slope
    below which it has converged, and whether it has."""

    slope: float | None
    threshold: float
    converged: bool


def judge(test: str, samples: Sequence[tuple[int, float]], rate: float, inverse_distance: float
          ) -> Verdict:
    """Test ("robust" or "paper") whether the scene frequency has converged.

    `samples` are (iteration, frequency) of one level, oldest first, and those that are not finite
    are ignored; `rate` is k, per step; `inverse_distance` is mean(1/d), 1 / world unit, for `paper`
    only.
    """
    samples = [sample for sample in samples if math.isfinite(sample[1])]
    count, scale = ((1, inverse_distance) if test == "paper" else
                    (MEDIAN_OF, samples[-1][1] if samples else 0.0))
    slopes = [(after - before) / (end - begin)
              for (begin, before), (end, after) in zip(samples, samples[1:])]
    slope = median(slopes[-count:]) if len(slopes) >= count else None
    return Verdict(slope, rate * scale, slope is not None and slope < rate * scale)
