"""A training that ends in time: its schedule is fitted to what a time budget leaves."""

import time
from collections.abc import Mapping
from typing import Any

from clsplat.config.option import is_auto
from clsplat.evaluation.views import METRICS, Metric, evaluate_views
from clsplat.options import seconds_of
from clsplat.schedule import Plan
from clsplat.training.budget import FAR_FROM_END, RESET_RECOVERY, TimeBudget
from clsplat.training.clock import Clock
from clsplat.training.evaluator import EVALUATIONS
from clsplat.training.model import checkpoint_bytes
from clsplat.training.rollback import Rollback
from clsplat.training.session import Session

COMPARED_VIEWS = 4  # training views by which two models are compared


class Deadline:
    """Adapts the number of steps of a session to the time that its steps take.

    Parameters
    ----------
    session, clock : of the training.
    final_metrics : of the last evaluation.

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
