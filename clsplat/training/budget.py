"""A time budget instead of a number of steps: the schedule is fitted to measured step times.

The number of steps is estimated repeatedly, from the measured time of a step at each level so far
and from the steps that the schedule predicts; shares, rates and degrees of the schedule follow it.
The budget is wall time from the start of `clsplat.training.loop.train`, with evaluations and files;
the time of a step is that of training alone. `deadline.Deadline` applies the budget.

Opacity resets, new levels and growth make a model worse before they make it better. Each happens
only if the time left allows the model to recover: measured on boruszyn (400 and 1500 steps of sig,
1500 of constant), the score of held-out views recovers 90 to 100 steps after an opacity reset, and
20 to 40 steps after growth. A level that no longer fits does not begin; the run then ends at the
present level.
"""

import math
from dataclasses import replace
from typing import Any

from clsplat.errors import InputError
from clsplat.schedule import Plan

ESTIMATE_SHARE = 0.005  # of the budget between two estimates
NEWEST_WEIGHT = 0.5  # of the newest measurement in a level's step time
FIRST_STEP_SECONDS = 0.05  # assumed before the first measurement
REPORT_SECONDS = 1.0  # to draw the run's page
BYTES_PER_SECOND = 100e6  # assumed for checkpoint and model before the first is written
RESERVE_SHARE = 0.005  # of the budget, for the unforeseen
RESET_RECOVERY = 150  # steps that must be left after an opacity reset
GROWTH_RECOVERY = 50  # steps that must be left after growth or a new level
FAR_FROM_END = 20 * RESET_RECOVERY  # steps left, which no wrong estimate turns into a few
EVALUATION_SHARE = 0.1  # of the budget at most
MOST_OVERHEAD = 0.5  # share of the budget that all but training may take


class TimeBudget:
    """Estimates how many steps a time allows.

    Parameters
    ----------
    seconds : the whole budget.
    evaluation_seconds : duration of one evaluation; the caller keeps it up to date.
    elapsed : seconds spent before the first step.
    saved_bytes : size of checkpoint and model.
    evaluations : requested number, evenly over the time; EVALUATION_SHARE may allow fewer.
    last_extra : seconds by which the last evaluation, which has more metrics, takes longer.

    Attributes
    ----------
    last_level : level at which the run ends, once the next one does not fit; None before.
    """

    def __init__(self, seconds: float, evaluation_seconds: float, elapsed: float,
                 saved_bytes: float, evaluations: int = 1, last_extra: float = 0.0) -> None:
        self.seconds, self.evaluation_seconds = seconds, evaluation_seconds
        self.last_extra = last_extra
        self.rate = BYTES_PER_SECOND
        self.pending = 0  # evaluations to come before the last one
        self.step_seconds: dict[float, float] = {}  # level -> seconds
        self.change_seconds = 0.0  # to change the level, which reads photos
        self.last_level: float | None = None
        self._since: tuple[int, float] | None = None  # (iteration, seconds) of the last measurement
        needed = elapsed + self.reserve(saved_bytes)
        if needed > MOST_OVERHEAD * seconds:
            least = math.ceil(1.1 * needed / MOST_OVERHEAD)  # the next try may measure more
            raise InputError(
                f"--time-budget {seconds:g}s: reading the photos, evaluating and saving once take "
                f"{needed:.1f} s here; give at least {least}s")
        affordable = EVALUATION_SHARE * seconds / max(evaluation_seconds, 1e-9)
        self._evaluations = max(1, int(min(evaluations, affordable)))
        self.pending = self._evaluations - 1

    def reserve(self, saved_bytes: float) -> float:
        """Seconds to reserve for evaluations to come, files and the page."""
        return (self.evaluation_seconds * (1 + self.pending) + self.last_extra
                + saved_bytes / self.rate + REPORT_SECONDS + RESERVE_SHARE * self.seconds)

    def evaluates(self, elapsed: float) -> bool:
        """Whether an evaluation is due now, other than the last one."""
        passed = int(self._evaluations * elapsed / self.seconds)
        if not self.pending or passed < self._evaluations - self.pending:
            return False
        self.pending = max(0, self._evaluations - 1 - passed)
        return True

    def is_due(self, elapsed: float) -> bool:
        """Whether another estimate is due."""
        return self._since is None or elapsed - self._since[1] > ESTIMATE_SHARE * self.seconds

    def begin_steps(self, iteration: int, elapsed: float) -> None:
        """Measure steps from here on."""
        self._since = iteration, elapsed

    def note_steps(self, iteration: int, level: float, elapsed: float) -> None:
        """Note the time of the steps since the last note, all at `level`."""
        if self._since and iteration > self._since[0]:
            latest = (elapsed - self._since[1]) / (iteration - self._since[0])
            before = self.step_seconds.get(level, latest)
            self.step_seconds[level] = before + NEWEST_WEIGHT * (latest - before)
        self._since = iteration, elapsed

    def note_change(self, seconds: float, iteration: int, elapsed: float) -> None:
        """Note the seconds that a change of level took, which are no part of a step."""
        self.change_seconds = max(self.change_seconds, seconds)
        self.begin_steps(iteration, elapsed)

    def note_saved(self, saved_bytes: float, seconds: float) -> None:
        """Note how long it took to write a checkpoint."""
        self.rate = max(saved_bytes / max(seconds, 1e-3), 1e6)

    def steps(self, iteration: int, ahead: list[tuple[float, float]], elapsed: float,
              saved_bytes: float) -> int:
        """Estimate the number of steps of the whole run.

        Parameters
        ----------
        iteration : steps taken so far.
        ahead : (level, steps) to come by the present estimate.
        elapsed : seconds since the start.
        saved_bytes : size of checkpoint and model.
        """
        left = self.seconds - elapsed - self.reserve(saved_bytes)
        predicted = sum(self._step_seconds(level) * steps for level, steps in ahead)
        count = sum(steps for _, steps in ahead)
        return iteration + max(0, int(count * left / predicted)) if predicted > 0 else iteration

    def left(self, level: float, changes: bool, elapsed: float, saved_bytes: float) -> int:
        """Number of steps for which there is certainly time.

        Parameters
        ----------
        level : of these steps.
        changes : whether the run has yet to change to this level.
        elapsed : seconds since the start.
        saved_bytes : size of checkpoint and model.
        """
        seconds = self.seconds - elapsed - self.reserve(saved_bytes)
        if changes:
            seconds -= self.change_seconds
        return max(0, int(seconds / self._step_seconds(level, power=2)))

    def allowed(self, plan: Plan, level: float, left: int) -> Plan:
        """Remove from a plan what the model could not recover from.

        Parameters
        ----------
        plan : of the next step.
        level : of the step before.
        left : number of steps for which there is time.
        """
        if self.last_level is None and plan.level != level and left < GROWTH_RECOVERY:
            self.last_level = level
        if self.last_level is not None:
            return replace(plan, level=self.last_level, grows=False, resets_opacity=False)
        return replace(plan, grows=plan.grows and left >= GROWTH_RECOVERY,
                       resets_opacity=plan.resets_opacity and left >= RESET_RECOVERY)

    def _step_seconds(self, level: float, power: int = 1) -> float:
        """Seconds of a step. For a level without measurement, that of the nearest level times a
        power of the ratio of their image sides."""
        if level in self.step_seconds:
            return self.step_seconds[level]
        if not self.step_seconds:
            return FIRST_STEP_SECONDS / level**power
        nearest = min(self.step_seconds, key=lambda seen: abs(seen - level))
        return self.step_seconds[nearest] * (nearest / level) ** power

    def state(self) -> dict[str, Any]:
        """State for a checkpoint, of types that JSON has."""
        return {"step_seconds": list(self.step_seconds.items()), "rate": self.rate,
                "change_seconds": self.change_seconds, "last_level": self.last_level}

    def load(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.step_seconds = dict(state["step_seconds"])
        self.rate = state["rate"]
        self.change_seconds = state["change_seconds"]
        self.last_level = state["last_level"]
