"""A round of growth: what a rule is given of the gaussians, and what becomes of its choice.

Sampling without replacement with probability in proportion to a weight is the choice of the highest
log weight + Gumbel noise (Efraimidis and Spirakis 2006). Every gaussian has its own draw, so that
excluding one does not change the draws of the others.
"""

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.grow import Growth, plan_growth, plan_relocation
from clsplat.densify.sphere import outside

if TYPE_CHECKING:
    from clsplat.options import ScheduledOptions

SPLIT_SIZE = 0.01  # share of the scene extent; larger gaussians are split, smaller ones cloned

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


class Round:
    """A round of growth of N gaussians, which `Schedule.grow` is given.

    Parameters
    ----------
    iteration : number of the step before it, from 1.
    rows : field name -> float32[N, *row shape], every field but the spherical harmonics.
    extent : of the scene, world units.
    options, prunes_large : of the training; whether ones larger than `prune_size` are removed.
    frozen : bool[N], gaussians that are not trained; they stay.
    gradient : returns float[N], mean screen gradients in NDC units, and waits for the device.
    scores : makes of these the scores float[N] of Taming 3DGS, and renders views.
    weights : returns float[N], how many pixels of the training views show each, and renders all.

    Attributes
    ----------
    rng : draws; a resumed run draws the same numbers.
    largest : float32[N], the largest of the three logarithms of standard deviations, world units.
    limit : the logarithm of the largest standard deviation that is not pruned.
    is_small, visible : bool[N], cloned rather than split; neither transparent nor outside a sphere.
    """

    def __init__(
        self,
        iteration: int,
        rows: dict[str, NDArray[np.float32]],
        extent: float,
        options: "ScheduledOptions",
        prunes_large: bool,
        frozen: Mask,
        gradient: Callable[[], Floats],
        scores: Callable[[Floats], Floats],
        weights: Callable[[], Floats],
    ) -> None:
        self.iteration, self.rows, self.options, self.frozen = iteration, rows, options, frozen
        self.rng = np.random.default_rng([options.seed, iteration])
        self._gradient, self._scores, self.weights = gradient, scores, weights
        # thresholds are taken to logarithms and logits rather than all rows from them
        x, y, z = rows["log_scales"].T
        self.largest = np.maximum(np.maximum(x, y), z)  # thirty times as fast as a reduction
        limited = prunes_large and options.prune_size > 0
        with np.errstate(divide="ignore"):  # a threshold of 0 or 1 is infinite
            self.limit = np.log(options.prune_size * extent if limited else np.finfo(float).max)
            self.is_small = self.largest <= np.log(np.float64(SPLIT_SIZE * extent))
            least = np.float64(options.prune_opacity)
            logit = np.log(least) - np.log1p(-least)
        self.visible: Mask = rows["opacity_logits"] >= logit  # false for NaN too
        if "anchors" in rows:
            self.visible &= ~outside(rows["positions"], rows["anchors"], rows["max_offsets"], options.sphere_reach)

    @cached_property
    def prunes(self) -> Mask:
        """bool[N], trained ones that are transparent, outside their sphere or too large."""
        stays: Mask = self.visible & (self.largest <= self.limit) | self.frozen
        return ~stays

    @cached_property
    def gradient(self) -> Floats:
        """float[N], mean screen gradients since the last round, NDC units; -inf for frozen ones."""
        gradient = self._gradient()
        return np.where(self.frozen, -np.inf, gradient) if self.frozen.any() else gradient

    @cached_property
    def scores(self) -> Floats:
        """float[N], the scores of Taming 3DGS, at least 0."""
        return self._scores(self._gradient())

    def room(self, target: int | None, count: int) -> int | None:
        """How many gaussians may be added to `count` trained ones that stay, up to a `target` of
        trained ones; None: any number."""
        limit = self.options.max_gaussians
        if limit:
            limit -= int(self.frozen.sum())
            target = limit if target is None else min(target, limit)
        return None if target is None else max(0, target - count)

    def above_threshold(self, room: int | None = None) -> Mask:
        """bool[N]: those whose gradient reaches `grow_threshold`, at most `room` (3DGS)."""
        mask = self.gradient >= self.options.grow_threshold
        return mask if room is None else _highest_of(mask, self.gradient, room)

    def highest(self, room: int) -> Mask:
        """bool[N]: those of the highest gradients that stay (DashGaussian)."""
        gradient = np.where(self.prunes, 0, self.gradient)
        return _highest_of(gradient > 0, gradient, room)

    def by_score(self, room: int, prunes: Mask) -> Mask:
        """bool[N]: those above the threshold, drawn by their scores (Taming 3DGS); none is one of
        `prunes`. Clones and splits share the room in proportion to how many are eligible."""
        scores, small = np.where(prunes, 0, self.scores), self.is_small
        eligible = self.gradient >= self.options.grow_threshold
        keys = _drawn_keys(scores, self.rng)
        total, clones = eligible.sum(), (eligible & small).sum()
        room = max(0, min(room, total))
        cloned = round(room * clones / total) if total else 0
        chosen = np.zeros(len(scores), bool)
        for kind, share in ((small, cloned), (~small, room - cloned)):
            chosen |= _first(np.where(eligible & kind, -keys, np.inf), share)
        return chosen & eligible & (scores > 0)

    def half_of_prunes(self) -> Mask:
        """bool[N]: half of `prunes`, drawn by how low their scores are (Taming 3DGS)."""
        weights = 1 / np.maximum(self.scores, np.finfo(float).tiny)
        keys = np.where(self.prunes, -_drawn_keys(weights, self.rng), np.inf)
        return _first(keys, self.prunes.sum() // 2)

    def densify(self, grows: Mask, prunes: Mask | None = None) -> Growth:
        """Clone the small ones among the gaussians that grow, and split the others in two.

        `grows` and `prunes` (None: those of the round) are bool[N]. One that is removed as too
        large may still be split, if its children are small enough.
        """
        return plan_growth(self, grows, self.prunes if prunes is None else prunes)

    def relocate(self, added: int) -> Growth:
        """Make copies of live gaussians, in place of transparent ones and, `added` of them, beside."""
        return plan_relocation(
            self.rows["opacity_logits"],
            self.rows["log_scales"],
            ~self.visible,
            self.frozen,
            added,
            self.options.prune_opacity,
            self.rng,
        )


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
    if not 0 < count < len(keys):
        return np.full(len(keys), count > 0)
    last = np.partition(keys, count - 1)[count - 1]
    mask: Mask = keys < last
    mask[np.flatnonzero(keys == last)[: count - mask.sum()]] = True
    return mask
