"""What of a training tells the time: of training alone, of all, and what a budget makes of it."""

import time

from clsplat.config.option import AUTO
from clsplat.evaluation.views import evaluate_views
from clsplat.options import seconds_of
from clsplat.schedule import laid_over
from clsplat.training import checkpoint
from clsplat.training.budget import LONG, RECOVERY, TimeBudget
from clsplat.training.kept import Kept

EVALUATIONS = 8  # of a run, by default
EVALUATION_SHARE = 1 / 3  # of the time so far, that they may take
SAMPLES = 4  # training views by which two models are compared


class Clock:
    """The part of a `loop.Training` that reads the clock; the rest is in loop.py.

    train_seconds, kernel_bytes: of training before the last pause; wall_seconds: before a resume;
    budget: TimeBudget or None.
    """

    def __init__(self, device):
        self.started = time.perf_counter()
        self.device, self.budget, self.kept = device, None, None
        self.train_seconds = self.wall_seconds = 0.0
        self.kernel_bytes = 0
        self.evaluation_seconds = self.latest_evaluation = 0.0  # in this process

    def pause(self):
        """Stop the training clock: what follows is not training."""
        self.device.finish()
        self.train_seconds += self._unpaused()
        self.kernel_bytes = self.moved()

    def unpause(self):
        self._clock = time.perf_counter() - self.device.build_seconds
        self._moved = self.device.kernel_bytes
        if self.budget:
            self.budget.begin_steps(self.iteration, self.stepped())

    def _unpaused(self):
        """Seconds of training since `unpause`, without those spent on compiling kernels."""
        return time.perf_counter() - self.device.build_seconds - self._clock

    def trained(self):
        """Seconds of training so far."""
        return self.train_seconds + self._unpaused()

    def moved(self):
        """Bytes of the arrays that training gave to kernels so far, once a launch."""
        return self.kernel_bytes + self.device.kernel_bytes - self._moved

    def stepped(self):
        """Wall seconds without compiling kernels: else the slow first step would make a time budget
        predict too few steps."""
        return self.elapsed() - self.device.build_seconds

    def elapsed(self):
        """Wall seconds since the run began, those before a resume included."""
        return self.wall_seconds + time.perf_counter() - self.started

    def evaluates(self):
        """Whether an evaluation follows the latest step, which is not the last."""
        options, iteration = self.options, self.iteration
        if iteration in options.eval_at:
            return True
        if options.eval_every != AUTO:
            return self.due(options.eval_every)
        if self.budget:
            return self.budget.evaluates(self.elapsed())
        if EVALUATIONS * iteration % options.iterations >= EVALUATIONS:  # no eighth ends here
            return False
        seconds = self.evaluation_seconds + self.latest_evaluation
        return seconds <= EVALUATION_SHARE * self.elapsed()

    def note_evaluation(self, seconds):
        """An evaluation took so long."""
        self.latest_evaluation = seconds
        self.evaluation_seconds += seconds
        if self.budget:
            self.budget.evaluation_seconds = seconds

    def measured_budget(self):
        """A TimeBudget that knows what evaluating takes here."""
        seconds = seconds_of(self.options.time_budget)
        each = 0.0
        for view in 2 * self.test_views[:1]:  # the first time builds kernels
            begin = time.perf_counter()
            evaluate_views(self.renderer, self.step.model.rows, self.options.sh_degree, [view])
            each = time.perf_counter() - begin
        return TimeBudget(seconds, each * len(self.test_views), self.elapsed(),
                          checkpoint.size(self.step.model),
                          EVALUATIONS if self.options.eval_every == AUTO else 1)

    def estimate_end(self):
        """Lay the schedule over the time that is left."""
        self.device.finish()
        self.budget.note_steps(self.iteration, self.level, self.stepped())
        ahead = self.schedule.ahead(self.iteration)
        if self.budget.last_level is not None:
            ahead = [(self.budget.last_level, sum(steps for _, steps in ahead))]
        self.lay_over(self.budget.steps(self.iteration, ahead, self.elapsed(),
                                        checkpoint.size(self.step.model)))

    def allowed(self, plan):
        """The Plan of the next step, less what a time budget leaves no time to recover from."""
        changes = plan.level != self.level
        if not self.budget or not (changes or plan.grows or plan.resets_opacity
                                   or self.budget.last_level is not None):
            return plan
        left = self.budget.left(plan.level, changes, self.elapsed(),
                                checkpoint.size(self.step.model))
        plan = self.budget.allowed(plan, self.level, left)
        if left < LONG and (plan.resets_opacity or plan.level != self.level):
            self.keep()
        return plan

    def keep(self):
        """Copy the model, should the budget end before it has recovered from what comes now."""
        if self.kept is None or self.iteration >= self.kept.iteration + RECOVERY:
            self.kept = Kept(self.step, self.iteration)

    def end_well(self):
        """At the end of a budget that came sooner than was foreseen: take back the model from
        before the last upheaval, where that was better."""
        kept, self.kept = self.kept, None
        if kept and self.iteration < kept.iteration + RECOVERY and kept.restore_if_better(
                self.step, self.scoring_views()[:SAMPLES]):
            self.log("restored", since=kept.iteration)
            self.progress.message(
                f"the time ended {self.iteration - kept.iteration} steps after opacities were "
                "lowered or a level began: the model from before that is kept, it was better")

    def lay_over(self, iterations):
        """Make the whole schedule one of so many steps."""
        self.options = laid_over(self.needs.options, iterations)
        self.schedule.options = self.step.options = self.options
