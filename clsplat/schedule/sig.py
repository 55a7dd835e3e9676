"""The SIG schedule (Xue et al. 2026): resolution and growth follow the scene's frequency.

Training begins with small images. When the scene frequency has converged at a level, the next one
begins (FARS). Each level grows for a number of rounds and then settles (DS), with no more gaussians
than its pixels can determine: the more the photos disagree about the colour of a place, the more
pixels a gaussian needs for its own, and the fewer steps are taken. From dense points, gaussians
that far fewer pixels show are removed when growth has ended. The paper has no safeguards; ours:
rounds of growth disturb the frequency, so it is tested only after them, several tests in a row must
agree, and each coarser level has a deadline, a share of the run, so that the finest always gets its
time. The tests `paper` and `release` have no safeguards, as published.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from clsplat.config.option import is_auto
from clsplat.errors import InputError
from clsplat.schedule.convergence import judge
from clsplat.schedule.plan import USUAL_PHOTOS, Plan, SceneFacts, Schedule, listed, sizes_text
from clsplat.schedule.sig_options import SigOptions

if TYPE_CHECKING:
    from clsplat.densify.grow import Growth
    from clsplat.densify.round import Round
    from clsplat.options import ScheduledOptions

LEVELS = (5.0, 4.0, 3.0, 2.0, 1.0)
DENSE_LEVELS = (8.0, 4.0, 2.0, 1.0)  # with which dense points enter: four times as many at each
BLOCK_LEVELS = (2.0, 1.0)
SMALLEST_SIDE = 64  # pixels: what smaller images teach, the next level learns at once
TILE = 16  # pixels
ROUND_STEPS = (100, 200)  # least and most between rounds of growth
LEAST_STEPS = 2 * ROUND_STEPS[0]  # of a level: in fewer, what it begins has no time to settle
LEAST_ENTERING = 50  # of a level that begins with points, and does not grow
COLOUR_ERROR = 0.0072  # of full brightness: the standard error of a gaussian's colour
LEAST_PIXELS_A_GAUSSIAN = 15.0  # where photos agree: it has 59 parameters, a pixel 3 values
USUAL_DISAGREEMENT = 0.03  # where the sparse model does not tell which photos show a point
MOST_A_PHOTO = 75  # steps for each training photo; after more, held-out photos get worse
ENOUGH = 3500  # steps, however few the photos are, if they agree
AGREEING = 0.036  # of full brightness: photos of a place that differ by more allow fewer steps
POWER = 3  # of that ratio; see docs/evidence/schedules.md
FEWEST, FEWEST_A_PHOTO = 1000, 50  # steps, however much the photos disagree

OBSERVE_STEPS = 100  # between samples of the frequency, fewer where levels are short
SAMPLES_A_LEVEL = 8
SETTLE_SHARE = 0.2  # of a level at most pass before its first round of growth (densify_from)
GROWS_SHARE = 0.7  # of a level's time; in the rest the new gaussians are trained
DENSE_GROWS_SHARE = 0.3  # from dense points, of which most places have one already
LEAST_SHOWN = 0.3  # of the pixels that a gaussian needs: what fewer show goes when growth ends
STAYING = 0.55  # share of the gaussians that then stay: 0.42 to 0.73 on seven sets
MOST_GROWTH = 5  # a round adds at most one gaussian for each so many (as in DashGaussian)
REPROJECT_DECAY = 0.1  # of the reprojection weight, by the end of the run


class Sig(Schedule):
    """Levels from coarse to fine; `observe` decides when the next begins."""

    parts = frozenset({"sig", "levels", "spheres", "reprojection"})
    keeps = ("index", "began", "rounds_taken", "carried", "grown_at", "full", "samples", "hits", "latest", "has_pruned")
    begins_dense = points_enter = True
    Options = SigOptions
    prunes_unneeded = False  # in the round of growth that follows the step

    @classmethod
    def grows_until(cls, options: "ScheduledOptions") -> int:
        """See `Schedule.grows_until`: to the end, as each level has its own rounds."""
        return options.iterations

    @classmethod
    def grows_every(cls, options: "ScheduledOptions") -> int:
        """See `Schedule.grows_every`: the length of a level decides (`every`)."""
        return 0

    @classmethod
    def planned_levels(cls, options: "ScheduledOptions", facts: SceneFacts) -> tuple[tuple[float, ...], str]:
        levels = levels_of(options, facts)
        sizes = sizes_text(levels, facts.size)
        if options.levels:
            return levels, f"{listed(levels)}: requested; {sizes}"
        dense = "dense points enter with them; " if facts.dense else ""
        return levels, (
            f"{listed(levels)}: {sizes}; {dense}sides below {SMALLEST_SIDE}, and "
            f"levels shorter than {least_steps(facts)} steps, are left out"
        )

    @classmethod
    def planned_limit(cls, options: "ScheduledOptions", facts: SceneFacts) -> tuple[int | None, str]:
        each = pixels_per_gaussian(options, facts)
        if not each:
            return None, "none: requested"
        limit = int(most_gaussians(options, facts, 1.0))
        if isinstance(options.pixels_per_gaussian, float):
            return limit, f"{limit:,}: one for each {each:g} training pixels, as requested"
        return limit, f"{limit:,}: one for each {each:.1f} training pixels, {facts.differing()}"

    @classmethod
    def most_steps(cls, options: "ScheduledOptions", facts: SceneFacts, photos: int) -> tuple[int, str]:
        """Held-out photos get worse after these, as gaussians then learn what the photos disagree
        about. The mean over n photos of a place keeps 1 / sqrt(n) of their disagreement."""
        visits: str | float = options.visits
        if isinstance(visits, float):
            return (
                max(1, round(visits * photos)) if visits else 0,
                f"for {photos:,} training photos, --visits {visits:g}",
            )
        if not is_auto(options.iterations):  # -n means what it says
            return 0, ""
        shown_in = USUAL_PHOTOS if math.isnan(facts.shown_in) else facts.shown_in
        left = facts.disagreement() * math.sqrt(USUAL_PHOTOS / shown_in)
        share = (AGREEING / left) ** POWER if left > AGREEING else 1.0  # 1 for a nan
        most = max(FEWEST, FEWEST_A_PHOTO * photos, round(share * max(ENOUGH, MOST_A_PHOTO * photos)))
        shown = f", and {facts.shown_in:.1f} show one" if facts.shown_in > 0 else ""
        return most, f"for {photos:,} training photos, {facts.differing()}{shown}"

    @classmethod
    def options_of_block(cls, options: "ScheduledOptions", size: tuple[int, int], facts: SceneFacts) -> dict[str, Any]:
        """See `Schedule.options_of_block`: the coarse run, at half size, had the coarser levels,
        and has pruned what it did not need. All blocks have the same pixels for a gaussian."""
        each = {"pixels_per_gaussian": pixels_per_gaussian(options, facts)}
        if options.levels:
            return each
        levels = chosen_levels(options, size, BLOCK_LEVELS, TILE)
        return {"levels": levels, **each}

    def __init__(self, options: "ScheduledOptions", facts: SceneFacts) -> None:
        super().__init__(options, facts)
        self.levels = levels_of(options, facts)
        self.shares = level_shares(self.levels, options.level_share)
        self.index = self.began = 0  # of the level, and how many steps were taken before it
        self.rounds_taken = self.carried = self.hits = 0
        self.grown_at = 0  # step of the last round
        self.full = facts.count >= self.ceiling
        self.samples: list[tuple[int, float]] = []
        self.least_shown = LEAST_SHOWN * pixels_per_gaussian(options, facts) if facts.dense else 0.0
        self.has_pruned = False  # what too few pixels show

    @property
    def guarded(self) -> bool:
        """Whether our safeguards apply."""
        return self.options.convergence == "robust"

    @property
    def last(self) -> bool:
        """Whether this is the finest level."""
        return self.index == len(self.levels) - 1

    @property
    def allotment(self) -> float:
        """Number of steps that this level may take."""
        steps = self.options.iterations
        return steps - self.began if self.last else self.shares[self.index] * steps

    @property
    def ceiling(self) -> float:
        """Up to how many gaussians this level grows: as many as its pixels can determine."""
        return most_gaussians(self.options, self.facts, self.levels[self.index])

    @property
    def observe_every(self) -> int:  # type: ignore[override]  # read-only here
        """Steps between samples of the frequency."""
        steps = min(self.shares, default=1.0) * self.options.iterations
        return max(1, min(OBSERVE_STEPS, int(steps / SAMPLES_A_LEVEL)))

    @property
    def grows_share(self) -> float:
        """Share of this level's time in which it may grow."""
        return DENSE_GROWS_SHARE if self.facts.dense else GROWS_SHARE

    @property
    def every(self) -> int:
        """Steps between rounds of growth."""
        o = self.options
        if o.densify_every:
            return o.densify_every
        low, high = ROUND_STEPS
        evenly = self.grows_share * self.allotment / o.rounds
        return max(1, int(min(max(evenly, min(low, self.allotment / SAMPLES_A_LEVEL)), high)))

    def plan(self, iteration: int) -> Plan:
        o, before = self.options, iteration - 1
        settle = min(o.densify_from, SETTLE_SHARE * self.allotment)
        in_rounds = self._rounds_left(before - self.began) and before < o.densify_until
        last = max(self.grown_at - 1, self.began + settle)
        grows = in_rounds and before >= last + self.every
        growing = in_rounds and not self.full
        self.prunes_unneeded = self.last and not in_rounds and not self.has_pruned and self.least_shown > 0
        progress = super().decay(iteration)
        return Plan(
            level=self.levels[self.index],
            degree=self.degree(iteration),
            gathers=growing,
            grows=grows or self.prunes_unneeded,
            resets_opacity=self._resets(before, growing),
            prunes_large=o.prune_size > 0,
            decay=self.decay(iteration) if self.guarded else progress,
            regularises=o.reproject_weight * REPROJECT_DECAY**progress if growing and o.reproject == "on" else 0.0,
        )

    def _rounds_left(self, since: int) -> bool:
        """Whether this level, so many steps old, still has rounds of growth to come."""
        if self.facts.dense and not self.last:  # the next level brings points
            return False
        in_time = since <= self.grows_share * self.allotment or not self.guarded
        return in_time and self.rounds_taken < self.options.rounds + self.carried

    def _resets(self, before: int, growing: bool) -> bool:
        """Whether opacities are reset after a step: every `reset_every` steps of growth. A new
        level resets none: that cost 1 to 4 dB, and half of the steps to win them back."""
        every = self.options.reset_every
        return growing and every > 0 and before > 0 and before % every == 0

    def decay(self, iteration: int) -> float:
        """See `Schedule.decay`: the position rate falls at the finest level only.

        A gaussian that has settled at a coarser level must still be able to move when finer images
        show where it belongs (docs/evidence/schedules.md).
        """
        left = self.options.iterations - self.began
        return min(1.0, (iteration - 1 - self.began) / max(1, left)) if self.last else 0.0

    def target(self, iteration: int, count: int, above: int) -> int | None:
        """See `Schedule.target`: up to `ceiling`, a fifth more in each round; for a forecast, what
        is about left where gaussians go that too few pixels show."""
        if self.prunes_unneeded:
            self.has_pruned = True
            return int(STAYING * count)
        self.rounds_taken += 1
        self.grown_at = iteration
        self.full = count >= self.ceiling
        if self.ceiling == math.inf:
            return None
        return max(count, min(int(self.ceiling), count + count // MOST_GROWTH))

    def grow(self, round: "Round") -> "Growth":
        """See `Schedule.grow`; once growth has ended, gaussians go that too few pixels show."""
        if self.prunes_unneeded:
            round.prunes |= (round.weights() < self.least_shown) & ~round.frozen
        return super().grow(round)

    def observe(self, iteration: int, frequency: dict[str, float]) -> dict[str, Any] | None:
        """See `Schedule.observe`; the decision is that the next level begins."""
        if self.last:
            self.latest = None
            return None
        o = self.options
        value = frequency[f"{o.frequency}_mean"]
        self.samples.append((iteration, value))
        since = iteration - self.began
        verdict = judge(o.convergence, self.samples, o.convergence_rate, self.facts.inverse_distance)
        disturbed = self.guarded and not self._settled(iteration)
        self.hits = 0 if disturbed or not verdict.converged else self.hits + 1
        self.latest = {"frequency": value, "slope": verdict.slope, "threshold": verdict.threshold, "hits": self.hits}
        if self.hits >= o.convergence_hits:
            reason = "converged"
        elif o.level_share != 1 and since + self.observe_every > self.allotment:
            reason = "deadline"
        else:
            return None
        decision = {
            "level": self.levels[self.index + 1],
            "reason": reason,
            "since": since,
            "rounds": self.rounds_taken,
            **self.latest,
        }
        self._advance(iteration)
        return decision

    def load(self, state: dict[str, Any]) -> None:
        """See `Schedule.load`; a run of an earlier version goes on without pruning at the end."""
        super().load({"has_pruned": True, **state})

    def ahead(self, iteration: int) -> list[tuple[float, float]]:
        """See `Schedule.ahead`: coarser levels until their deadline, the rest at the finest."""
        coarser = [
            (level, share * self.options.iterations)
            for level, share in zip(self.levels[self.index :], self.shares[self.index :])
        ]
        if coarser:
            coarser[0] = coarser[0][0], max(0, self.allotment - (iteration - self.began))
        rest = self.options.iterations - iteration - sum(steps for _, steps in coarser)
        return [*coarser, (self.levels[-1], max(0, rest))]

    def _settled(self, iteration: int) -> bool:
        """Whether this level's growth is over, with enough samples after it for a test."""
        since = iteration - self.began
        # rounds that only prune disturb little
        return self.full or (not self._rounds_left(since) and iteration >= self.grown_at + 2 * self.observe_every)

    def _advance(self, iteration: int) -> None:
        if self.options.convergence == "release":  # where unused rounds are kept and add up
            self.carried += max(0, self.options.rounds - self.rounds_taken)
        self.index += 1
        self.began = iteration
        self.rounds_taken = self.hits = 0
        self.full, self.samples = False, []


def level_shares(levels: Sequence[float], together: float | str) -> tuple[float, ...]:
    """The share of the run that each of the coarser levels may take, in proportion to its
    resolution.

    `together` is that of all coarser levels; auto: the finest, too, has its share in proportion.
    """
    *coarser, finest = (1 / level for level in levels)
    if isinstance(together, str):
        together = sum(coarser) / (sum(coarser) + finest)
    return tuple(together * resolution / sum(coarser) for resolution in coarser)


def pixels_per_gaussian(options: "ScheduledOptions", facts: SceneFacts) -> float:
    """The least number of training pixels for each gaussian; 0: any number.

    The mean of n colours that scatter by s has a standard error of s / sqrt(n).
    """
    requested: str | float = options.pixels_per_gaussian
    if isinstance(requested, float):
        return requested
    scatter = facts.disagreement()
    if math.isnan(scatter):
        scatter = USUAL_DISAGREEMENT
    return max(LEAST_PIXELS_A_GAUSSIAN, (scatter / COLOUR_ERROR) ** 2)


def most_gaussians(options: "ScheduledOptions", facts: SceneFacts, level: float) -> float:
    """Number of gaussians that the training pixels of a level can determine; may be inf."""
    each = pixels_per_gaussian(options, facts)
    return math.floor(facts.pixels / level**2 / each) if each else math.inf


def levels_of(options: "ScheduledOptions", facts: SceneFacts) -> tuple[float, ...]:
    """The levels of a training of the whole scene."""
    return chosen_levels(options, facts.size, DENSE_LEVELS if facts.dense else LEVELS, steps=least_steps(facts))


def least_steps(facts: SceneFacts) -> int:
    """The fewest steps of a level."""
    return LEAST_ENTERING if facts.dense else LEAST_STEPS


def chosen_levels(
    options: "ScheduledOptions",
    size: tuple[int, int],
    candidates: tuple[float, ...] = LEVELS,
    least: int = SMALLEST_SIDE,
    steps: int = LEAST_STEPS,
) -> tuple[float, ...]:
    """The down-sampling factors of a training, for a smallest image of `size` (width, height),
    pixels.

    The default ones are `candidates` without sides below `least` pixels and the coarsest levels
    for which there are not so many `steps`. InputError if a requested factor makes an image
    smaller than a tile.
    """
    levels, side = options.levels, min(size)
    if levels:
        if int(side / levels[0]) < TILE and levels[0] > 1:
            raise InputError(
                f"--levels: level {levels[0]:g} would train on images of "
                f"{int(size[0] / levels[0])} x {int(size[1] / levels[0])} pixels, less than a tile "
                f"of {TILE}; give smaller --levels, or larger photos by a smaller --downscale or a "
                "larger --max-resolution"
            )
        return levels
    levels = tuple(level for level in candidates if level == 1 or side / level >= least)
    while (shares := level_shares(levels, options.level_share)) and (shares[0] * options.iterations < steps):
        levels = levels[1:]
    return levels
