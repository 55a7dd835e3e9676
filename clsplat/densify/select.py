"""Choice of the gaussians that grow, and of the candidates for pruning that are removed.

Sampling without replacement with probability in proportion to a weight is the choice of the highest
log weight + Gumbel noise (Efraimidis and Spirakis 2006). Every gaussian has its own draw, so that
excluding one does not change the draws of the others.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


def above_threshold(gradient: Floats, threshold: float, room: int | None = None) -> Mask:
    """The gaussians whose gradient reaches a threshold (3DGS).

    `room` is the largest number to choose, by highest gradient, then by row; None: any number.
    """
    mask = gradient >= threshold
    return mask if room is None else _highest_of(mask, gradient, room)


def highest(gradient: Floats, count: int) -> Mask:
    """The `count` gaussians of the highest gradients above 0 (DashGaussian), among equals the
    first."""
    return _highest_of(gradient > 0, gradient, count)


def by_score(scores: Floats, gradient: Floats, threshold: float, small: Mask, count: int,
             rng: np.random.Generator) -> Mask:
    """Gaussians above a threshold, drawn with probability in proportion to a score (Taming 3DGS).

    Clones (`small`) and splits share the count in proportion to how many of them are eligible.
    """
    eligible = gradient >= threshold
    keys = _drawn_keys(scores, rng)
    chosen = np.zeros(len(gradient), bool)
    total, clones = eligible.sum(), (eligible & small).sum()
    count = max(0, min(count, total))
    cloned = round(count * clones / total) if total else 0
    for kind, share in ((small, cloned), (~small, count - cloned)):
        chosen |= _first(np.where(eligible & kind, -keys, np.inf), share)
    return chosen & eligible & (scores > 0)


def half_of(candidates: Mask, scores: Floats, rng: np.random.Generator) -> Mask:
    """Half of the candidates, rounded down, drawn with probability in proportion to 1 / score
    (Taming 3DGS); those of score 0 are drawn first."""
    weights = 1 / np.maximum(scores, np.finfo(float).tiny)
    keys = np.where(candidates, -_drawn_keys(weights, rng), np.inf)
    return _first(keys, candidates.sum() // 2)


def _drawn_keys(weights: Floats, rng: np.random.Generator) -> NDArray[np.float64]:
    with np.errstate(divide="ignore"):
        keys: NDArray[np.float64] = np.log(weights) + rng.gumbel(size=len(weights))
    return keys


def _highest_of(mask: Mask, gradient: Floats, count: int) -> Mask:
    """Those of a mask that have its `count` highest gradients, which no other's exceeds."""
    rows = np.flatnonzero(mask)
    mask[rows] = _first(-gradient[rows], count)
    return mask


def _first(keys: Floats, count: int) -> Mask:
    """bool[N]: the `count` lowest keys, among equals the first."""
    if count <= 0 or count >= len(keys):
        return np.full(len(keys), count > 0)
    last = np.partition(keys, count - 1)[count - 1]
    mask: Mask = keys < last if last == last else ~np.isnan(keys)  # NaN comes last
    equal = np.flatnonzero(keys == last if last == last else np.isnan(keys))
    mask[equal[:count - mask.sum()]] = True
    return mask
