"""What of a training tells the time: of training alone, of all, and what a budget makes of it."""

import time

from clsplat.evaluate.views import evaluate_views
from clsplat.options import seconds_of
from clsplat.schedule import laid_over
from clsplat.train import checkpoint
from clsplat.train.budget import TimeBudget


class Clock:
    """The part of a `loop.Training` that reads the clock; the rest is in loop.py.

    train_seconds, kernel_bytes: of training before the last pause; wall_seconds: before a resume;
    budget: TimeBudget or None.
    """

    def __init__(self, device):
        self.started = time.perf_counter()
        self.device, self.budget = device, None
        self.train_seconds = self.wall_seconds = 0.0
        self.kernel_bytes = 0

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
        """Seconds of training since `unpause`; compiling kernels is none."""
        return time.perf_counter() - self.device.build_seconds - self._clock

    def trained(self):
        """Seconds of training so far."""
        return self.train_seconds + self._unpaused()

    def moved(self):
        """Bytes of the arrays that training gave to kernels so far, once a launch."""
        return self.kernel_bytes + self.device.kernel_bytes - self._moved

    def stepped(self):
        """`elapsed` less compiling, by which the first step would foretell a run of few."""
        return self.elapsed() - self.device.build_seconds

    def elapsed(self):
        """Wall seconds since the run began, those before a resume included."""
        return self.wall_seconds + time.perf_counter() - self.started

    def measured_budget(self):
        """A TimeBudget that knows what evaluating takes here."""
        seconds = seconds_of(self.options.time_budget)
        each = 0.0
        for view in 2 * self.test_views[:1]:  # the first time builds kernels
            begin = time.perf_counter()
            evaluate_views(self.renderer, self.step.model.rows, self.options.sh_degree, [view])
            each = time.perf_counter() - begin
        return TimeBudget(seconds, each * len(self.test_views), self.elapsed(),
                          checkpoint.size(self.step.model))

    def estimate_end(self):
        """Lay the schedule over the time that is left."""
        self.device.finish()
        self.budget.note_steps(self.iteration, self.level, self.stepped())
        self.lay_over(self.budget.steps(self.iteration, self.schedule.ahead(self.iteration),
                                        self.elapsed(), checkpoint.size(self.step.model)))

    def lay_over(self, iterations):
        """Make the whole schedule one of so many steps."""
        self.options = laid_over(self.needs.options, iterations)
        self.schedule.options = self.step.options = self.options
