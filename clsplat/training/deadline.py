"""A training that ends in time: its schedule is laid over what a time budget leaves."""

import time
from typing import Any

from clsplat.config.option import AUTO
from clsplat.evaluation.views import evaluate_views
from clsplat.options import seconds_of
from clsplat.schedule import Plan
from clsplat.training.budget import LONG, RECOVERY, TimeBudget
from clsplat.training.clock import Clock
from clsplat.training.evaluator import EVALUATIONS
from clsplat.training.model import checkpoint_bytes
from clsplat.training.rollback import Rollback
from clsplat.training.session import Session

COMPARED_VIEWS = 4  # training views by which two models are compared


class Deadline:
    """Moves the number of steps of a Session with the time that its steps take.

    Attributes
    ----------
    budget : the arithmetic.
    """

    def __init__(self, session: Session, clock: Clock) -> None:
        self.session, self.clock = session, clock
        self._rollback: Rollback | None = None
        options, each = session.options, 0.0
        for view in 2 * session.test_views[:1]:  # the first time builds kernels
            begin = time.perf_counter()
            evaluate_views(session.renderer, session.model.rows, options.sh_degree, [view])
            each = time.perf_counter() - begin
        self.budget = TimeBudget(
            seconds_of(options.time_budget), each * len(session.test_views), clock.elapsed(),
            checkpoint_bytes(session.model), EVALUATIONS if options.eval_every == AUTO else 1)
        self.note_change()

    def begin(self) -> None:
        """What comes from now on are steps."""
        self.budget.begin_steps(self.session.iteration, self.clock.trained())

    def note_change(self) -> None:
        """The session has gone to another level, whose photos had to be read."""
        self.budget.note_change(self.session.photos.read_seconds, self.session.iteration,
                                self.clock.trained())

    def note_saved(self, seconds: float) -> None:
        """A checkpoint was written in so many seconds."""
        self.budget.note_saved(checkpoint_bytes(self.session.model), seconds)

    def allowed(self, plan: Plan) -> Plan:
        """The Plan of the next step, less what leaves no time to recover from it."""
        session, budget = self.session, self.budget
        changes = plan.level != session.level
        if not (changes or plan.grows or plan.resets_opacity or budget.last_level is not None):
            return plan
        left = budget.left(plan.level, changes, self.clock.elapsed(),
                           checkpoint_bytes(session.model))
        plan = budget.allowed(plan, session.level, left)
        if left < LONG and (plan.resets_opacity or plan.level != session.level):
            self.keep()
        return plan

    def keep(self) -> None:
        """Copy the model, should the budget end before it has recovered from what comes now."""
        step, iteration = self.session.step, self.session.iteration
        if self._rollback is None or iteration >= self._rollback.iteration + RECOVERY:
            self._rollback = Rollback(step, iteration)

    def estimate(self) -> None:
        """Lay the schedule over the time that is left, where it is time for that."""
        session, budget = self.session, self.budget
        if not budget.is_due(self.clock.trained()):
            return
        session.device.finish()
        budget.note_steps(session.iteration, session.level, self.clock.trained())
        ahead = session.schedule.ahead(session.iteration)
        if budget.last_level is not None:
            ahead = [(budget.last_level, sum(steps for _, steps in ahead))]
        session.lay_over(budget.steps(session.iteration, ahead, self.clock.elapsed(),
                                      checkpoint_bytes(session.model)))

    def rolled_back(self) -> int | None:
        """At an end that came sooner than was expected: go back to the model from before the last
        opacity reset or change of level, where that was better. Its step, or None."""
        session, kept, self._rollback = self.session, self._rollback, None
        if kept and session.iteration < kept.iteration + RECOVERY and kept.restore_if_better(
                session.step, session.scoring_views()[:COMPARED_VIEWS]):
            return kept.iteration
        return None

    def state(self) -> dict[str, Any]:
        """What a checkpoint must hold, for JSON."""
        return {**self.budget.state(), "iterations": self.session.options.iterations}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from the `state` that a checkpoint held."""
        self.budget.load(state)
        self.session.lay_over(state["iterations"])
