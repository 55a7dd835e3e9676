"""Which gaussians grow, and which candidates of pruning go: masks from a few numbers a gaussian.

Sampling without replacement with probability in proportion to a weight is the choice of the highest
log weight + Gumbel noise (Efraimidis and Spirakis 2006), one draw a gaussian: what becomes of one
does not move the draws of the others.
"""

import numpy as np


def above_threshold(gradient, threshold, room=None):
    """bool[N]: where the mean screen gradient float[N] is at least `threshold` (3DGS).

    room: how many at most (None: any number), the highest first, among equals the first.
    """
    mask = gradient >= threshold
    return mask if room is None else mask & _first(-gradient, room)


def highest(gradient, wanted):
    """bool[N]: the `wanted` highest of gradient float[N] (DashGaussian), among equals the first.

    Those with no gradient are left out, even if fewer than wanted have one.
    """
    return (gradient > 0) & _first(-gradient, wanted)


def by_score(scores, gradient, threshold, small, wanted, rng):
    """bool[N]: some `wanted` of those at or above the threshold, drawn by score (Taming 3DGS).

    scores: float[N], at least 0; small: bool[N], those that would be cloned, not split. Both kinds
    share `wanted` in proportion to how many of them are eligible; within a kind, members are drawn
    with probability in proportion to their score. A score of 0 is never drawn.
    """
    eligible = gradient >= threshold
    keys = _drawn_keys(scores, rng)
    chosen = np.zeros(len(gradient), bool)
    total, clones = eligible.sum(), (eligible & small).sum()
    wanted = max(0, min(wanted, total))
    shared = round(wanted * clones / total) if total else 0
    for kind, share in ((small, shared), (~small, wanted - shared)):
        chosen |= _first(np.where(eligible & kind, -keys, np.inf), share)
    return chosen & eligible & (scores > 0)


def half_of(candidates, scores, rng):
    """bool[N]: half of candidates bool[N], rounded down, drawn with probability in proportion to
    1 / score (Taming 3DGS); those with a score of 0 come first."""
    weights = 1 / np.maximum(scores, np.finfo(float).tiny)
    keys = np.where(candidates, -_drawn_keys(weights, rng), np.inf)
    return _first(keys, candidates.sum() // 2)


def _drawn_keys(weights, rng):
    with np.errstate(divide="ignore"):
        return np.log(weights) + rng.gumbel(size=len(weights))


def _first(keys, count):
    """bool[N]: the `count` lowest keys, among equals the first."""
    mask = np.zeros(len(keys), bool)
    mask[np.argsort(keys, kind="stable")[:max(0, count)]] = True
    return mask
