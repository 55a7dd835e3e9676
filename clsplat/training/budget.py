"""A time budget in place of a number of steps: the schedule is fitted to measured step times.

The number of steps is estimated repeatedly, from the measured time of a step at each level so far
and from the steps that the schedule predicts; shares, rates and degrees of the schedule follow it.
The budget is wall time from the start of `clsplat.training.loop.train`, with evaluations and files;
the time of a step is that of training alone. `Deadline` applies the budget to a session, and goes
back to a `Rollback` if the run ends too soon after what made its model worse.

Opacity resets, new levels and growth make a model worse before they make it better. Each happens
only if the time left allows the model to recover: measured on boruszyn (400 and 1500 steps of sig,
1500 of constant), the score of held-out views recovers 90 to 100 steps after an opacity reset, and
20 to 40 steps after growth. A level that no longer fits does not begin; the run then ends at the
present level.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from clsplat.config.option import is_auto
from clsplat.errors import InputError
from clsplat.evaluation.views import METRICS, Metric, evaluate_views
from clsplat.gaussians import LEARNED
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.options import seconds_of
from clsplat.rendering.project import Rows
from clsplat.schedule import Plan
from clsplat.training.clock import Clock
from clsplat.training.evaluator import EVALUATIONS
from clsplat.training.model import checkpoint_bytes
from clsplat.training.part import ViewPass
from clsplat.training.session import Session
from clsplat.training.step import Step

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
COMPARED_VIEWS = 4  # training views by which two models are compared


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


class Deadline:
    """Adapts the number of steps of a session to the time that its steps take.

    Parameters
    ----------
    session : the state of the training.
    clock : its time.
    final_metrics : metrics of the last evaluation.

    Attributes
    ----------
    budget : estimates the number of steps.
    """

    def __init__(self, session: Session, clock: Clock, final_metrics: Mapping[str, Metric]) -> None:
        self.session, self.clock = session, clock
        self._rollback: Rollback | None = None
        options, view = session.options, session.test_views[:1]
        each, last = 0.0, 0.0
        for metrics in (METRICS, METRICS, final_metrics) if view else ():  # the first compiles
            begin = time.perf_counter()
            evaluate_views(session.renderer, session.model.rows, options.sh_degree, view,
                           metrics=metrics)
            each, last = last, time.perf_counter() - begin
        self.budget = TimeBudget(
            seconds_of(options.time_budget), each * len(session.test_views), clock.elapsed(),
            self._checkpoint_bytes(), EVALUATIONS if is_auto(options.eval_every) else 1,
            (last - each) * len(session.test_views))
        self.note_change()

    def begin(self) -> None:
        """Measure steps from here on."""
        self.budget.begin_steps(self.session.iteration, self.clock.trained())

    def note_change(self) -> None:
        """Note that the session has changed its level, for which photos were read."""
        self.budget.note_change(self.session.photos.read_seconds, self.session.iteration,
                                self.clock.trained())

    def note_saved(self, seconds: float) -> None:
        """Note the seconds that a checkpoint took."""
        self.budget.note_saved(self._checkpoint_bytes(), seconds)

    def _checkpoint_bytes(self) -> int:
        return checkpoint_bytes(self.session.step.count, self.session.options.sh_degree)

    def allowed(self, plan: Plan) -> Plan:
        """The plan of the next step, without what the model could not recover from."""
        session, budget = self.session, self.budget
        changes = plan.level != session.level
        if not (changes or plan.grows or plan.resets_opacity or budget.last_level is not None):
            return plan
        left = budget.left(plan.level, changes, self.clock.elapsed(),
                           self._checkpoint_bytes())
        plan = budget.allowed(plan, session.level, left)
        if left < FAR_FROM_END and (plan.resets_opacity or plan.level != session.level):
            self.keep()
        return plan

    def keep(self) -> None:
        """Copy the model, in case the budget ends before it has recovered from the next step."""
        step, iteration = self.session.step, self.session.iteration
        if self._rollback is None or iteration >= self._rollback.iteration + RESET_RECOVERY:
            self._rollback = Rollback(step, iteration)

    def estimate(self) -> None:
        """Fit the schedule to the time left, if an estimate is due."""
        session, budget = self.session, self.budget
        if not budget.is_due(self.clock.trained()):
            return
        session.device.finish()
        budget.note_steps(session.iteration, session.level, self.clock.trained())
        ahead = session.schedule.ahead(session.iteration)
        if budget.last_level is not None:
            ahead = [(budget.last_level, sum(steps for _, steps in ahead))]
        session.lay_over(budget.steps(session.iteration, ahead, self.clock.elapsed(),
                                      self._checkpoint_bytes()))

    def rolled_back(self) -> int | None:
        """Return to the model before the last opacity reset or change of level, if it was better.

        This happens where the end came sooner than expected. Returns the step of that model, or
        None.
        """
        session, kept, self._rollback = self.session, self._rollback, None
        if not kept or session.iteration >= kept.iteration + RESET_RECOVERY:
            return None
        session.step.release()  # the copy may need the memory of frames
        views = session.scoring_views()[:COMPARED_VIEWS]
        return kept.iteration if kept.restore_if_better(session.step, views) else None

    def state(self) -> dict[str, Any]:
        """State for a checkpoint, of types that JSON has."""
        return {**self.budget.state(), "iterations": self.session.options.iterations}

    def load(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.budget.load(state)
        self.session.lay_over(state["iterations"])


class Rollback:
    """Rows and moments of a model, in host memory.

    Attributes
    ----------
    iteration : steps taken before the copy.
    """

    def __init__(self, step: Step, iteration: int) -> None:
        model = step.model
        self.iteration = iteration
        model.catch_up()
        self._gaussians, self._moments = model.download(), model.adam.download()

    def restore_if_better(self, step: Step, samples: Sequence[ViewPass]) -> bool:
        """Restore the copy if its loss is smaller than that of the present model.

        Parameters
        ----------
        step : has the present model, and receives the copy.
        samples : training views.

        Returns
        -------
        Whether the copy was restored.
        """
        model = step.model
        model.catch_up()
        kept = {field.name: step.device.upload(self._gaussians.rows[field.name])
                for field in LEARNED}
        if not _loss(step, kept, samples) < _loss(step, model.rows, samples):
            return False
        model.adopt(self._gaussians)
        model.adam.upload(*self._moments)
        step.statistics.clear(model.count)
        step.rows_changed()
        return True


def _loss(step: Step, rows: Rows, samples: Sequence[ViewPass]) -> float:
    """The mean image loss of some views, without colour transforms."""
    losses = []
    for sample in samples:
        photo, (_, height, width) = sample.photo, sample.photo.shape
        frame = step.renderer.render(rows, sample.camera, width, height, step.options.sh_degree)
        partials, _ = image_loss(step.device, frame.exposed, photo, step.options.ssim_weight)
        losses.append(loss_value(partials, 3 * height * width, step.options.ssim_weight)[0])
    return float(np.mean(losses))
