"""A time budget instead of a number of steps: the schedule is laid over measured step times.

The number of steps is estimated again and again from what steps take at the levels seen so far and
from those the schedule still has to come; the schedule's shares, rates and degrees follow it. The
budget is of wall time from the start of `clsplat.training.loop.train`, evaluations and files
included; steps are measured by the time of training alone. `deadline.Deadline` applies it.

Lowered opacities, new levels and growth make a model worse before they make it better. Each begins
only while the time that is left allows the steps to recover from it: measured on boruszyn (400 and
1500 steps of sig, 1500 of constant), the score of held-out views is back after 90 to 100 steps
where opacities were lowered, and after 20 to 40 steps of growth. A level that no longer fits does
not begin; the run ends at the level that it has.
"""

import math
from dataclasses import replace
from typing import Any

from clsplat.errors import InputError
from clsplat.schedule import Plan

EVERY = 0.005  # of the budget passes between estimates
MEMORY = 0.5  # weight of the newest measurement of a level
FIRST_STEP_SECONDS = 0.05  # until one was measured
REPORT_SECONDS = 1.0  # of drawing the run's page
BYTES_PER_SECOND = 100e6  # of writing checkpoint and model, until one was written
SPARE = 0.005  # of the budget, for what no estimate foresees
RECOVERY = 150  # steps that must be left where opacities are lowered
SETTLING = 50  # ... where a level begins, or the model grows
LONG = 20 * RECOVERY  # steps: with more left, no estimate is so wrong that a run ends soon
EVALUATION_SHARE = 0.1  # of the budget
TOO_LITTLE = 0.5  # share of the budget that all but training may take


class TimeBudget:
    """How many steps a time allows.

    Parameters
    ----------
    seconds : all there is.
    evaluation_seconds : of evaluating once, to be kept up to date.
    elapsed : seconds spent before the first step.
    saved_bytes : of checkpoint and model.
    evaluations : wanted, evenly over the time; those are made that EVALUATION_SHARE allows.

    Attributes
    ----------
    last_level : the level that the run stays at, once another does not fit; None before.
    """

    def __init__(self, seconds: float, evaluation_seconds: float, elapsed: float,
                 saved_bytes: float, evaluations: int = 1) -> None:
        self.seconds, self.evaluation_seconds = seconds, evaluation_seconds
        self.rate = BYTES_PER_SECOND
        self.pending = 0  # evaluations still to come before the last
        self.step_seconds: dict[float, float] = {}  # level -> seconds
        self.change_seconds = 0.0  # of going to another level: reading its photos
        self.last_level: float | None = None
        self._since = None  # (iteration, seconds) of the last measurement
        needed = elapsed + self.reserve(saved_bytes)
        if needed > TOO_LITTLE * seconds:
            least = math.ceil(1.1 * needed / TOO_LITTLE)  # the next try may measure more
            raise InputError(
                f"--time-budget {seconds:g}s: reading the photos, evaluating and saving once take "
                f"{needed:.1f} s here; give at least {least}s")
        affordable = EVALUATION_SHARE * seconds / max(evaluation_seconds, 1e-9)
        self._evaluations = max(1, int(min(evaluations, affordable)))
        self.pending = self._evaluations - 1

    def reserve(self, saved_bytes: float) -> float:
        """Seconds to keep for the evaluations to come, the files and the page."""
        return (self.evaluation_seconds * (1 + self.pending) + saved_bytes / self.rate
                + REPORT_SECONDS + SPARE * self.seconds)

    def evaluates(self, elapsed: float) -> bool:
        """Whether it is time for an evaluation, one of those before the last."""
        passed = int(self._evaluations * elapsed / self.seconds)
        if not self.pending or passed < self._evaluations - self.pending:
            return False
        self.pending = max(0, self._evaluations - 1 - passed)
        return True

    def is_due(self, elapsed: float) -> bool:
        """Whether it is time for another estimate."""
        return self._since is None or elapsed - self._since[1] > EVERY * self.seconds

    def begin_steps(self, iteration: int, elapsed: float) -> None:
        """What comes from now on are steps."""
        self._since = iteration, elapsed

    def note_steps(self, iteration: int, level: float, elapsed: float) -> None:
        """Measure the steps since the last note, all at `level`."""
        if self._since and iteration > self._since[0]:
            latest = (elapsed - self._since[1]) / (iteration - self._since[0])
            before = self.step_seconds.get(level, latest)
            self.step_seconds[level] = before + MEMORY * (latest - before)
        self._since = iteration, elapsed

    def note_change(self, seconds: float, iteration: int, elapsed: float) -> None:
        """Going to another level took so long, which is no time of a step."""
        self.change_seconds = max(self.change_seconds, seconds)
        self.begin_steps(iteration, elapsed)

    def note_saved(self, saved_bytes: float, seconds: float) -> None:
        """Writing so many bytes took so long."""
        self.rate = max(saved_bytes / max(seconds, 1e-3), 1e6)

    def steps(self, iteration: int, ahead: list[tuple[float, int]], elapsed: float,
              saved_bytes: float) -> int:
        """The number of steps of the whole run, as of `iteration`; ahead: (level, steps) still to
        come by the present estimate."""
        left = self.seconds - elapsed - self.reserve(saved_bytes)
        predicted = sum(self._step_seconds(level) * steps for level, steps in ahead)
        steps = sum(steps for _, steps in ahead)
        return iteration + max(0, int(steps * left / predicted)) if predicted > 0 else iteration

    def left(self, level: float, changes: bool, elapsed: float, saved_bytes: float) -> int:
        """Steps at `level` for which there is time, carefully judged; changes: whether the level
        is still to be gone to."""
        seconds = self.seconds - elapsed - self.reserve(saved_bytes)
        if changes:
            seconds -= self.change_seconds
        return max(0, int(seconds / self._step_seconds(level, power=2)))

    def allowed(self, plan: Plan, level: float, left: int) -> Plan:
        """The Plan of a step, less what `left` steps do not allow to recover from; level: that of
        the step before."""
        if self.last_level is None and plan.level != level and left < SETTLING:
            self.last_level = level
        if self.last_level is not None:
            return replace(plan, level=self.last_level, grows=False, resets_opacity=False)
        return replace(plan, grows=plan.grows and left >= SETTLING,
                       resets_opacity=plan.resets_opacity and left >= RECOVERY)

    def _step_seconds(self, level, power=1):
        """Of a level not seen yet: as if time grew with this power of the image's side, from the
        nearest."""
        if level in self.step_seconds:
            return self.step_seconds[level]
        if not self.step_seconds:
            return FIRST_STEP_SECONDS / level**power
        nearest = min(self.step_seconds, key=lambda seen: abs(seen - level))
        return self.step_seconds[nearest] * (nearest / level) ** power

    def state(self) -> dict[str, Any]:
        """What a checkpoint must hold, for JSON."""
        return {"step_seconds": list(self.step_seconds.items()), "rate": self.rate,
                "change_seconds": self.change_seconds, "last_level": self.last_level}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from the `state` that a checkpoint held."""
        self.step_seconds = {level: seconds for level, seconds in state["step_seconds"]}
        self.rate = state["rate"]
        self.change_seconds = state["change_seconds"]
        self.last_level = state["last_level"]
