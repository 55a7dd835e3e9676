"""A round of growth: what a rule is given of the gaussians, and what becomes of its choice."""

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.grow import Candidates, plan_growth
from clsplat.densify.relocate import plan_relocation
from clsplat.densify.select import above_threshold, by_score, half_of, highest
from clsplat.schedule.growth import Growth

if TYPE_CHECKING:
    from clsplat.options import ScheduledOptions

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


class MeasuredRound:
    """The `schedule.growth.Round` of a training, which describes its attributes and methods.

    `gradient` returns float[N], mean screen gradients in NDC units, and waits for the device;
    `scores` makes of these the scores float[N] of Taming 3DGS, and renders views.
    """

    def __init__(self, iteration: int, candidates: Candidates, options: "ScheduledOptions",
                 frozen: Mask, gradient: Callable[[], Floats],
                 scores: Callable[[Floats], Floats]) -> None:
        self.iteration, self.options, self.frozen = iteration, options, frozen
        self.rows = candidates.rows
        self.rng = np.random.default_rng([options.seed, iteration])
        self._candidates, self._gradient, self._scores = candidates, gradient, scores

    @cached_property
    def prunes(self) -> Mask:
        """See `Round`."""
        return self._candidates.prunes & ~self.frozen

    @cached_property
    def gradient(self) -> Floats:
        """See `Round`."""
        gradient = self._gradient()
        return np.where(self.frozen, -np.inf, gradient) if self.frozen.any() else gradient

    @cached_property
    def scores(self) -> Floats:
        """See `Round`."""
        return self._scores(self._gradient())

    def room(self, target: int | None, count: int) -> int | None:
        """See `Round`."""
        limit = self.options.max_gaussians
        if limit:
            limit -= int(self.frozen.sum())
            target = limit if target is None else min(target, limit)
        return None if target is None else max(0, target - count)

    def above_threshold(self, room: int | None = None) -> Mask:
        """See `Round`."""
        return above_threshold(self.gradient, self.options.grow_threshold, room)

    def highest(self, room: int) -> Mask:
        """See `Round`."""
        return highest(np.where(self.prunes, 0, self.gradient), room)

    def by_score(self, room: int, prunes: Mask) -> Mask:
        """See `Round`."""
        return by_score(np.where(prunes, 0, self.scores), self.gradient,
                        self.options.grow_threshold, self._candidates.is_small, room, self.rng)

    def half_of_prunes(self) -> Mask:
        """See `Round`."""
        return half_of(self.prunes, self.scores, self.rng)

    def densify(self, grows: Mask, prunes: Mask | None = None) -> Growth:
        """See `Round`."""
        return plan_growth(self._candidates, grows, self.prunes if prunes is None else prunes,
                           self.rng)

    def relocate(self, added: int) -> Growth:
        """See `Round`."""
        return plan_relocation(self.rows["opacity_logits"], self.rows["log_scales"],
                               ~self._candidates.visible, self.frozen, added,
                               self.options.prune_opacity, self.rng)
