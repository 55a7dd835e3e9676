"""What a round of growth makes of the gaussians, as the schedule selects them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.grow import Candidates, Growth, plan_growth
from clsplat.densify.relocate import plan_relocation
from clsplat.densify.scores import taming_scores
from clsplat.densify.select import above_threshold, by_score, half_of, highest
from clsplat.gaussians import FIELDS
from clsplat.options import ScheduledOptions
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import Rows
from clsplat.schedule import Plan, Schedule
from clsplat.training.part import ViewPass

ScoringViews = Callable[[], list[ViewPass]]


@dataclass(frozen=True, eq=False)
class Round:
    """A round of growth.

    Attributes
    ----------
    iteration : number of the step before it, from 1.
    plan : of that step.
    schedule : decides how many gaussians are added, and how they are selected.
    options : of the training.
    extent : of the scene, world units.
    gradient : returns float[N], mean screen gradients; called where the schedule needs them.
    frozen : bool[N], gaussians that are not trained; they stay.
    """

    iteration: int
    plan: Plan
    schedule: Schedule
    options: ScheduledOptions
    extent: float
    gradient: Callable[[], NDArray[np.floating]]
    frozen: NDArray[np.bool_]

    def growth(self, renderer: Renderer, rows: Rows, scoring_views: ScoringViews) -> Growth:
        """Decide what becomes of each gaussian.

        Parameters
        ----------
        renderer : renders views, for a schedule that scores gaussians.
        rows : field name -> real[N, *row shape].
        scoring_views : returns some training views.
        """
        options = self.options
        host = {field.name: rows[field.name].download() for field in FIELDS
                if field.name in rows and not field.name.startswith("sh_")}
        # counter-based: a resumed run draws the same numbers
        rng = np.random.default_rng([options.seed, self.iteration])
        candidates = Candidates(host, self.extent, options, self.plan.prunes_large)
        if self.schedule.selection == "relocation":
            count = int((~self.frozen).sum())
            return plan_relocation(host["opacity_logits"], host["log_scales"], ~candidates.visible,
                                   self.frozen, self._room(count, 0) or 0,
                                   options.prune_opacity, rng)
        prunes, scores, gradient = candidates.prunes & ~self.frozen, None, self.gradient()
        if self.schedule.selection == "score":
            scores = taming_scores(renderer, rows, scoring_views(), self.plan.degree,
                                   options.ssim_weight, gradient)
            if self.schedule.spares_half(self.iteration):
                prunes = half_of(prunes, scores, rng)
        if self.frozen.any():
            gradient = np.where(self.frozen, -np.inf, gradient)
        grows = self._selected(gradient, candidates, prunes, scores, rng)
        return plan_growth(candidates, grows, prunes, rng)

    def _room(self, count: int, above: int) -> int | None:
        """How many gaussians may be added; None: any number.

        Parameters
        ----------
        count : gaussians that stay, without the frozen ones.
        above : how many of them exceed the growth threshold.
        """
        target = self.schedule.target(self.iteration, count, above)
        limit = self.options.max_gaussians
        if limit:
            limit -= int(self.frozen.sum())
            target = limit if target is None else min(target, limit)
        return None if target is None else max(0, target - count)

    def _selected(self, gradient: NDArray[np.floating], candidates: Candidates,
                  prunes: NDArray[np.bool_], scores: NDArray[np.floating] | None,
                  rng: np.random.Generator) -> NDArray[np.bool_]:
        """The gaussians [N] that are cloned or split, each of which adds one; `gradient` is -inf
        for frozen ones."""
        threshold, selection = self.options.grow_threshold, self.schedule.selection
        counted, above = ~prunes & ~self.frozen, gradient >= threshold
        room = self._room(int(counted.sum()), int((counted & above).sum()))
        if room is None:
            return above_threshold(gradient, threshold)
        if selection == "score":
            assert scores is not None  # `growth` has computed them
            return by_score(np.where(prunes, 0, scores), gradient, threshold, candidates.is_small,
                            room, rng)
        if selection == "highest":
            return highest(np.where(prunes, 0, gradient), room)
        # a split replaces a gaussian that is too large by two
        room -= int((prunes & above).sum())
        return above_threshold(gradient, threshold, room)
