"""A time budget instead of a number of steps: the schedule is laid over measured step times.

The number of steps is estimated again and again from what steps take at the levels seen so far and
from those the schedule still has to come; the schedule's shares, rates and degrees follow it. Time
is wall time from the start of `clsplat.train.loop.train`, evaluations and files included.
"""

import math

from clsplat.errors import InputError

EVERY = 0.005  # of the budget passes between estimates
MEMORY = 0.5  # weight of the newest measurement of a level
FIRST_STEP_SECONDS = 0.05  # until one was measured
REPORT_SECONDS = 1.0  # of drawing the run's page
BYTES_PER_SECOND = 100e6  # of writing checkpoint and model, until one was written
SPARE = 0.005  # of the budget, for what no estimate foresees
TOO_LITTLE = 0.5  # share of the budget that all but training may take


class TimeBudget:
    """seconds: all there is; evaluation_seconds: of evaluating once, to be kept up to date;
    elapsed: seconds spent before the first step; saved_bytes: of checkpoint and model."""

    def __init__(self, seconds, evaluation_seconds, elapsed, saved_bytes):
        self.seconds, self.evaluation_seconds = seconds, evaluation_seconds
        self.rate = BYTES_PER_SECOND
        self.step_seconds = {}  # level -> seconds
        self._since = None  # (iteration, seconds) of the last measurement
        needed = elapsed + self.reserve(saved_bytes)
        if needed > TOO_LITTLE * seconds:
            least = math.ceil(1.1 * needed / TOO_LITTLE)  # the next try may measure more
            raise InputError(
                f"--time-budget {seconds:g}s: reading the photos, evaluating and saving once take "
                f"{needed:.1f} s here; give at least {least}s")

    def reserve(self, saved_bytes):
        """Seconds to keep for the last evaluation, the files and the page."""
        return (self.evaluation_seconds + saved_bytes / self.rate + REPORT_SECONDS
                + SPARE * self.seconds)

    def is_due(self, elapsed):
        """Whether it is time for another estimate."""
        return self._since is None or elapsed - self._since[1] > EVERY * self.seconds

    def begin_steps(self, iteration, elapsed):
        """What comes from now on are steps."""
        self._since = iteration, elapsed

    def note_steps(self, iteration, level, elapsed):
        """Measure the steps since the last note, all at `level`."""
        if self._since and iteration > self._since[0]:
            latest = (elapsed - self._since[1]) / (iteration - self._since[0])
            before = self.step_seconds.get(level, latest)
            self.step_seconds[level] = before + MEMORY * (latest - before)
        self._since = iteration, elapsed

    def note_saved(self, saved_bytes, seconds):
        self.rate = max(saved_bytes / max(seconds, 1e-3), 1e6)

    def steps(self, iteration, ahead, elapsed, saved_bytes):
        """The number of steps of the whole run, as of `iteration`.

        ahead: [(level, steps still to come by the present estimate)].
        """
        left = self.seconds - elapsed - self.reserve(saved_bytes)
        predicted = sum(self._step_seconds(level) * steps for level, steps in ahead)
        steps = sum(steps for _, steps in ahead)
        return iteration + max(0, int(steps * left / predicted)) if predicted > 0 else iteration

    def _step_seconds(self, level):
        """Of a level not seen yet: as if time grew with the image's side, from the nearest."""
        if level in self.step_seconds:
            return self.step_seconds[level]
        if not self.step_seconds:
            return FIRST_STEP_SECONDS / level
        nearest = min(self.step_seconds, key=lambda seen: abs(seen - level))
        return self.step_seconds[nearest] * nearest / level

    def state(self):
        """What a checkpoint must hold, for JSON."""
        return {"step_seconds": list(self.step_seconds.items()), "rate": self.rate}

    def load(self, state):
        self.step_seconds = {level: seconds for level, seconds in state["step_seconds"]}
        self.rate = state["rate"]
