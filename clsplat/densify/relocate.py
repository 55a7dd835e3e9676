"""Relocation of dead gaussians, and growth, by sampling live ones (Kheradmand et al. 2024).

A dead gaussian becomes a copy of a live one, drawn with probability in proportion to opacity, and
so does each new gaussian. The copies of a gaussian and it itself share what it contributed: their
opacity and size are chosen so that the sum looks as it did (eq. 9).
"""

import numpy as np
from numpy.typing import NDArray

from clsplat.schedule.growth import Growth

Floats = NDArray[np.float64]
STEP, REACH = 0.25, 8.0  # of the sum for an integral, standard deviations; its error is below 1e-12
OPACITY_MAX = 1 - 2.0**-20  # the logit of 1 is infinite


def plan_relocation(opacity_logits: NDArray[np.floating], log_scales: NDArray[np.floating],
                    dead: NDArray[np.bool_], frozen: NDArray[np.bool_], added: int,
                    least_opacity: float, rng: np.random.Generator) -> Growth:
    """Decide which gaussians become copies of which, in one draw for relocation and growth.

    Where no gaussian lives nothing changes. The moments of all gaussians that share begin at 0.
    Those of `dead`, bool[N], are relocated; those of `frozen` do not change and are not drawn; the
    model grows by `added`; no copy gets less than `least_opacity`.
    """
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-opacity_logits.astype(np.float64)))
    moves = dead & ~frozen
    cumulative = np.cumsum(np.where(dead | frozen, 0.0, opacities))
    copies, lives = int(moves.sum()) + added, bool(cumulative[-1] > 0)
    if not (copies and lives):
        return Growth(np.arange(len(dead), dtype=np.uint32), len(dead), 0, 0, 0, {})
    # 1 - random() is never 0, so that none is drawn that has no share
    drawn = np.searchsorted(cumulative, (1 - rng.random(copies)) * cumulative[-1])
    times = np.bincount(drawn, minlength=len(dead))
    parents = np.flatnonzero(times)
    sharing = np.concatenate([parents, np.repeat(parents, times[parents])])
    opacity, shrink = shared(opacities[parents], times[parents] + 1)
    opacity = np.clip(opacity, least_opacity, OPACITY_MAX)
    stays = np.flatnonzero(~moves & (times == 0))

    def of_sharing(values: Floats) -> Floats:
        return np.concatenate([values, np.repeat(values, times[parents], axis=0)])

    logits = of_sharing(np.log(opacity) - np.log1p(-opacity))
    scales = log_scales[sharing] + of_sharing(np.log(shrink))[:, None]
    return Growth(np.concatenate([stays, sharing]).astype(np.uint32), len(stays), copies, 0,
                  int(moves.sum()), {"opacity_logits": (len(stays), logits.astype(np.float32)),
                                     "log_scales": (len(stays), scales.astype(np.float32))})


def shared(opacity: Floats, number: NDArray[np.integer]) -> tuple[Floats, Floats]:
    """The opacity o' of each of N equal gaussians in place of one, and the factor of their size.

    Stacked in one place they are as opaque in their middle as the one was, 1 - (1 - o')^N = o, and
    along a line across it the integral of their opacity is the same:

        o sqrt(2 pi) s = s' integral of 1 - (1 - o' exp(-x^2 / 2))^N

    The binomial theorem makes of this the double sum of eq. 9, whose terms alternate and cancel;
    the integral has no such terms, for any N. All are [S]; `opacity` is above 0, `number` (N) too.
    """
    with np.errstate(divide="ignore"):  # an opacity of 1
        each = -np.expm1(np.log1p(-opacity) / number)
        total = np.zeros(len(opacity))
        for x in np.arange(0.0, REACH + STEP, STEP):  # the trapezoidal rule, for half of the line
            weight = STEP if x else STEP / 2
            total -= weight * np.expm1(number * np.log1p(-each * np.exp(-x * x / 2)))
    return each, opacity * np.sqrt(np.pi / 2) / total
