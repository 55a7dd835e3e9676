"""A time budget in place of a number of steps: the schedule is fitted to measured step times.

The number of steps is estimated again and again, from the measured time of a step at each level
and from the steps that the schedule predicts. The budget is wall time from the start of
`clsplat.training.run.train`, with evaluations and files; the time of a step is that of training
alone.

Opacity resets, new levels and growth make a model worse before they make it better, so each happens
only if the time left allows the model to recover: measured on boruszyn (400 and 1500 steps of sig,
1500 of constant), the score of held-out views recovers 90 to 100 steps after an opacity reset, and
20 to 40 steps after growth. A level that no longer fits does not begin.
"""

import math
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.config.option import is_auto
from clsplat.errors import InputError
from clsplat.evaluation.views import evaluate_views, scored_at_once
from clsplat.io.atomic import replacing
from clsplat.options import seconds_of
from clsplat.schedule.plan import Plan
from clsplat.training.current import CurrentRenderer
from clsplat.training.model import checkpoint_bytes
from clsplat.training.recorder import EVALUATION_SHARE, EVALUATIONS, Clock
from clsplat.training.session import Session

ESTIMATE_SHARE = 0.005  # of the budget between two estimates
NEWEST_WEIGHT = 0.5  # of the newest measurement in a level's step time
FIRST_STEP_SECONDS = 0.05  # assumed before the first measurement
REPORT_SECONDS = 1.0  # to draw the run's page
TRIAL_BYTES = 1 << 25  # that are written to see how fast the disk is
SAVED_A_SECOND = 1e9  # bytes of a checkpoint, where the disk takes no time
RESERVE_SHARE = 0.005  # of the budget, for the unforeseen
RESET_RECOVERY = 150  # steps that must be left after an opacity reset
GROWTH_RECOVERY = 50  # steps that must be left after growth or a new level
MOST_OVERHEAD = 0.5  # share of the budget that all but training may take


def evaluation_seconds(session: Session) -> float:
    """Seconds of an evaluation, measured on as many views as are scored at the same time."""
    seconds, views = 0.0, session.test_views
    some = views[: scored_at_once(views)]
    for measured in (some[:1], some) if some else ():  # the first compiles
        begin = time.perf_counter()
        evaluate_views(CurrentRenderer(session.renderer), session.model, session.options.sh_degree, measured)
        seconds = time.perf_counter() - begin
    return seconds * len(views) / max(1, len(some))


def saved_a_second(folder: Path) -> float:
    """Bytes of a checkpoint that are written into a folder in a second, measured on its disk."""
    content = os.urandom(TRIAL_BYTES)
    begin = time.perf_counter()
    with replacing(folder / "trial") as file:
        file.write(content)
    seconds = time.perf_counter() - begin
    (folder / "trial").unlink()
    return 1 / (seconds / TRIAL_BYTES + 1 / SAVED_A_SECOND)


class Deadline:
    """Adapts the number of steps of a session to the time that its steps take.

    An evaluation takes at most `evaluation` seconds, unless one turns out to take more. `rate` :
    bytes of a checkpoint that are written in a second, until one was.
    """

    def __init__(self, session: Session, clock: Clock, evaluation: float, rate: float) -> None:
        self.session, self.clock, self._evaluation = session, clock, evaluation
        self._seconds = seconds = seconds_of(session.options.time_budget)
        self._rate = rate
        self._pending = 0  # evaluations to come before the last one
        self._step_seconds: dict[float, float] = {}  # level -> seconds
        self._change_seconds = 0.0  # to change the level, which reads photos
        self._last_level: float | None = None  # at which the run ends, as the next does not fit
        needed = clock.elapsed() + self._reserve()
        if needed > MOST_OVERHEAD * seconds:
            least = math.ceil(1.1 * needed / MOST_OVERHEAD)  # the next try may measure more
            raise InputError(
                f"--time-budget {seconds:g}s: reading the photos, evaluating and saving once take "
                f"{needed:.1f} s here; give at least {least}s"
            )
        wanted = EVALUATIONS if is_auto(session.options.eval_every) else 1
        affordable = EVALUATION_SHARE * seconds / max(evaluation, 1e-9)
        self._evaluations = max(1, int(min(wanted, affordable)))
        self._pending = self._evaluations - 1
        self.note_change()

    def begin(self) -> None:
        """Measure steps from here on."""
        self._since = self.session.iteration, self.clock.trained()

    def note_change(self) -> None:
        """Note that the session has changed its level, for which photos were read."""
        self._change_seconds = max(self._change_seconds, self.session.photos.read_seconds)
        self.begin()

    def note_saved(self, seconds: float) -> None:
        """Note the seconds that a checkpoint took."""
        self._rate = max(self._saved_bytes(self.session.step.count) / max(seconds, 1e-3), 1e6)

    def note_evaluated(self, seconds: float) -> None:
        """Note the seconds that an evaluation took."""
        self._evaluation = max(self._evaluation, seconds)

    def allowed(self, plan: Plan) -> Plan:
        """The plan of the next step, without what the model could not recover from."""
        level = self.session.level
        changes, ends = plan.level != level, self._last_level is not None
        if not (changes or plan.grows or plan.resets_opacity or ends):
            return plan
        # as many steps as there certainly is time for
        left = (self._left() - changes * self._change_seconds) / self._seconds_at(plan.level, 2)
        if changes and not ends and left < GROWTH_RECOVERY:
            self._last_level = level
        if self._last_level is not None:
            return replace(plan, level=self._last_level, grows=False, resets_opacity=False)
        return replace(
            plan,
            grows=plan.grows and left >= GROWTH_RECOVERY,
            resets_opacity=plan.resets_opacity and left >= RESET_RECOVERY,
        )

    def estimate(self) -> None:
        """Fit the schedule to the time left, if an estimate is due."""
        session, (before, since) = self.session, self._since
        if self.clock.trained() - since <= ESTIMATE_SHARE * self._seconds:
            return
        session.device.finish()
        if session.iteration > before:
            latest = (self.clock.trained() - since) / (session.iteration - before)
            known = self._step_seconds.get(session.level, latest)
            self._step_seconds[session.level] = known + NEWEST_WEIGHT * (latest - known)
        self.begin()
        ahead = session.schedule.ahead(session.iteration)
        if self._last_level is not None:
            ahead = [(self._last_level, sum(steps for _, steps in ahead))]
        count = sum(steps for _, steps in ahead)
        predicted = sum(self._seconds_at(level) * steps for level, steps in ahead)
        more = int(count * self._left() / predicted) if predicted > 0 else 0
        session.lay_over(session.iteration + max(0, more))

    def evaluates(self) -> bool:
        """Whether an evaluation is due now, other than the last one: they are evenly spaced."""
        passed = int(self._evaluations * self.clock.elapsed() / self._seconds)
        if not self._pending or passed < self._evaluations - self._pending:
            return False
        self._pending = max(0, self._evaluations - 1 - passed)
        return True

    def _left(self) -> float:
        """Seconds for steps."""
        return self._seconds - self.clock.elapsed() - self._reserve()

    def _reserve(self) -> float:
        """Seconds to reserve for evaluations to come, files and the page."""
        # also of the gaussians that have not entered yet (parts/entering_points.py)
        count = max(self.session.step.count, self.session.schedule.facts.count)
        return (
            self._evaluation * (1 + self._pending)
            + self._saved_bytes(count) / self._rate
            + REPORT_SECONDS
            + RESERVE_SHARE * self._seconds
        )

    def _saved_bytes(self, count: int) -> int:
        return checkpoint_bytes(count, self.session.options.sh_degree)

    def _seconds_at(self, level: float, power: int = 1) -> float:
        """Seconds of a step. For a level without measurement, that of the nearest level times a
        power of the ratio of their image sides."""
        if not self._step_seconds:
            return FIRST_STEP_SECONDS / level**power
        nearest = min(self._step_seconds, key=lambda seen: abs(seen - level))
        return self._step_seconds[nearest] * (nearest / level) ** power

    def state(self) -> dict[str, Any]:
        """State for a checkpoint, of types that JSON has."""
        return {
            "step_seconds": list(self._step_seconds.items()),
            "rate": self._rate,
            "change_seconds": self._change_seconds,
            "last_level": self._last_level,
            "iterations": self.session.options.iterations,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self._step_seconds, self._rate = dict(state["step_seconds"]), state["rate"]
        self._change_seconds, self._last_level = state["change_seconds"], state["last_level"]
        self.session.lay_over(state["iterations"])
