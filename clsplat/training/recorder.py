"""Reports a training: to metrics.jsonl, to the progress line, and to the user's callbacks."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from clsplat.errors import InputError, StopTraining
from clsplat.io.runs.run import RunFolder
from clsplat.report.scores import is_upheaval
from clsplat.training.clock import Clock
from clsplat.training.progress import SilentProgress
from clsplat.training.session import Session
from clsplat.training.step import TOO_MANY, Measured

REPORT_EVERY = 50  # steps between progress lines; each waits for the device
LOG_EVERY = 100
Callback = Callable[[dict[str, Any]], object]  # called with a record


class Recorder:
    """Reports the steps of a session.

    Attributes
    ----------
    progress : the progress line.
    stop : whether a callback has raised an exception, after which the step is finished and saved.
    failure : the first exception of a callback that is not StopTraining, to be raised then.
    upheavals : event -> step of its latest record, of those that lower the scores for a while.
    """

    def __init__(self, session: Session, clock: Clock, run: RunFolder, progress: SilentProgress,
                 callbacks: Iterable[Callback] = ()) -> None:
        self.session, self.clock, self.run, self.progress = session, clock, run, progress
        self._callbacks, self.stop = tuple(callbacks), False
        self.failure: BaseException | None = None
        self.upheavals: dict[str, int] = {}

    def _place(self) -> dict[str, Any]:
        """The keys of every record, which tell where the training is."""
        session, clock = self.session, self.clock
        return {"iteration": session.iteration, "train_seconds": round(clock.trained(), 3),
                "wall_seconds": round(clock.elapsed(), 3), "level": session.level,
                "gaussians": session.step.count}

    def log(self, event: str, **values: Any) -> None:
        """Write one record of metrics.jsonl; its first keys are those of every record."""
        record = {"event": event, **self._place(), "pixel_pairs": self.session.step.pixel_pairs,
                  "kernel_bytes": self.clock.moved(), **values}
        self.run.log(record)
        if is_upheaval(record):
            self.upheavals[event] = self.session.iteration
        if event != "step":  # callbacks receive every step from `stepped`
            self._show(record)

    def stepped(self, measured: list[Measured], frequency: dict[str, float] | None) -> None:
        """Report a step, if a report is due; InputError where training cannot go on.

        Parameters
        ----------
        measured : the result of the step.
        frequency : scene frequencies, if they were measured.
        """
        iteration = self.session.iteration
        reports = iteration % REPORT_EVERY == 0 or iteration == 1
        if not (reports or self._callbacks):
            return
        values = self.check(measured)
        if reports:
            self._report(values, frequency)
        self._show({"event": "step", **self._place(), **values})

    def _show(self, record: dict[str, Any]) -> None:
        for function in self._callbacks:
            try:
                function(record)
            except StopTraining:
                self.stop = True
            except BaseException as error:  # noqa: BLE001  (raised again by `raise_failure`)
                self.stop, self.failure = True, self.failure or error

    def raise_failure(self) -> None:
        """Raise the exception of a callback, if there was one."""
        if self.failure is not None:
            raise self.failure

    def _report(self, values: dict[str, float], frequency: dict[str, float] | None) -> None:
        session = self.session
        iteration, skipped = session.iteration, session.step.skipped
        memory = session.device.memory_bytes
        self.progress(iteration=iteration, total=session.options.iterations, loss=values["loss"],
                      gaussians=session.step.count, memory_bytes=memory, level=session.level)
        if iteration % LOG_EVERY == 0 or iteration == 1:
            since, requested = skipped.close()
            self.log("step", **values, memory_bytes=memory, peak_bytes=session.device.peak_bytes,
                     skipped_rows=skipped.total, skipped_since=since, frequency=frequency,
                     convergence=session.schedule.latest)
            if iteration > 1 and since > TOO_MANY * requested:  # a single view proves little
                raise broken(self.run, f"{since:,} of {requested:,} gradients were not finite in "
                             f"the {LOG_EVERY} steps to {iteration}")

    def check(self, measured: list[Measured]) -> dict[str, float]:
        """The values of a step, such as `loss`; waits. InputError where one is not finite.

        Gradients that are not finite are only counted; the first are reported.
        """
        step, iteration = self.session.step, self.session.iteration
        values = step.values(measured)
        for name, value in values.items():
            if not np.isfinite(value):
                raise broken(self.run, f"the {name} at step {iteration} is {value}")
        if step.poll_skipped():
            self.progress.message(f"step {iteration}: {step.skipped.total:,} gradients were not "
                                  "finite and were skipped; metrics.jsonl counts them as "
                                  "skipped_rows")
        return values


def broken(run: RunFolder, what: str,
           cure: str = "lower the learning rates or check the scene") -> InputError:
    """The InputError of a training that cannot go on."""
    kept = ("the last checkpoint is kept" if run.has_checkpoint
            else "there is no checkpoint yet")
    return InputError(f"{run.path}: {what}; {kept}: {cure}")
