"""Measures a training and reports it: to metrics.jsonl, the user and the user's callbacks."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from clsplat.config.option import is_auto
from clsplat.device import Device
from clsplat.errors import InputError, StopTraining
from clsplat.evaluation.views import evaluate_views, expected_seconds
from clsplat.io.runs.run import RunFolder
from clsplat.report.scores import disturbed, is_upheaval, main_key
from clsplat.training.current import CurrentRenderer
from clsplat.training.progress import SilentProgress
from clsplat.training.session import Session
from clsplat.training.step import Measured

REPORT_EVERY = 50  # steps between progress lines; each waits for the device
LOG_EVERY = 100
EVALUATIONS = 8  # in a run, by default
EVALUATION_SHARE = 1 / 8  # of the time, so far or of a budget, that evaluations may take
FIRST_SECONDS = 0.5  # expected of the first evaluation, at least
# Share of the rows between two records above which training stops. Good runs skip none, and a few
# broken gaussians cause some in a million. A skipped gaussian does not change, and its neighbours
# learn to compensate: with one in a hundred the result is no longer the scene.
TOO_MANY = 0.01
Callback = Callable[[dict[str, Any]], object]  # called with a record


class Clock:
    """Measures time; it starts at once."""

    def __init__(self, device: Device) -> None:
        self._device, self._started = device, time.perf_counter()
        self._train_seconds = self._wall_seconds = 0.0  # before the last pause; before a resume
        self.restart()

    def restart(self, before: float = 0.0) -> None:
        """Exclude the time since the last pause from training, but for seconds `before`."""
        self._train_seconds += before
        self._since: float | None = time.perf_counter() - self._device.build_seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude the time of the block from training."""
        self._device.finish()
        self._train_seconds, self._since = self.trained(), None
        yield
        self.restart()

    def trained(self) -> float:
        """Seconds of training so far, without the compilation of kernels."""
        since = 0.0 if self._since is None else (time.perf_counter() - self._device.build_seconds - self._since)
        return self._train_seconds + since

    def elapsed(self) -> float:
        """Wall seconds since the run began, including those before a resume."""
        return self._wall_seconds + time.perf_counter() - self._started

    def state(self) -> dict[str, float]:
        """State for a checkpoint, while paused."""
        return {"train_seconds": self._train_seconds, "wall_seconds": self.elapsed()}

    def load(self, state: dict[str, float]) -> None:
        """Restore what `state` returned."""
        self._train_seconds, self._wall_seconds = state["train_seconds"], state["wall_seconds"]


class Recorder:
    """Reports the steps and the evaluations of a session.

    Once a callback raises an exception, `stop` is set, and the step is finished and saved; then
    `failure` is raised, the first one that is not StopTraining.
    """

    def __init__(
        self,
        session: Session,
        clock: Clock,
        run: RunFolder,
        progress: SilentProgress,
        callbacks: Iterable[Callback] = (),
    ) -> None:
        self.session, self.clock, self.run, self.progress = session, clock, run, progress
        self._callbacks, self.stop = tuple(callbacks), False
        self.failure: BaseException | None = None
        self._told, self._reported = False, (0, 0)  # of skipped gradients; `Step.skipped` then
        self.upheavals: dict[str, int] = {}  # event that lowers the scores for a while -> step

    def _place(self) -> dict[str, Any]:
        """The keys of every record: where the training is."""
        session, clock = self.session, self.clock
        return {
            "iteration": session.iteration,
            "train_seconds": round(clock.trained(), 3),
            "wall_seconds": round(clock.elapsed(), 3),
            "level": session.level,
            "gaussians": session.step.count,
        }

    def log(self, event: str, **values: Any) -> None:
        """Write one record of metrics.jsonl; its first keys are those of every record."""
        record = {"event": event, **self._place(), "pixel_pairs": self.session.step.pixel_pairs, **values}
        self.run.log(record)
        if is_upheaval(record):
            self.upheavals[event] = self.session.iteration
        if event != "step":  # callbacks receive every step from `stepped`
            self._show(record)

    def stepped(self, measured: list[Measured], frequency: dict[str, float] | None) -> None:
        """Report a step and the scene frequencies, if they were measured, where a report is due;
        InputError where training cannot go on."""
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
        iteration, step = session.iteration, session.step
        memory = session.device.memory_bytes
        self.progress(
            iteration=iteration,
            total=session.options.iterations,
            loss=values["loss"],
            gaussians=session.step.count,
            memory_bytes=memory,
            level=session.level,
        )
        if iteration % LOG_EVERY == 0 or iteration == 1:
            skipped, computed = step.skipped()
            since, among = skipped - self._reported[0], computed - self._reported[1]
            self._reported = skipped, computed
            self.log(
                "step",
                **values,
                memory_bytes=memory,
                peak_bytes=session.device.peak_bytes,
                skipped_rows=step.skipped_before + skipped,
                skipped_since=since,
                frequency=frequency,
                convergence=session.schedule.latest,
            )
            if iteration > 1 and since > TOO_MANY * among:  # a single view proves little
                raise broken(
                    self.run,
                    f"{since:,} of {among:,} gradients were not finite in the {LOG_EVERY} steps to {iteration}",
                )

    def check(self, measured: list[Measured]) -> dict[str, float]:
        """The values of a step, such as `loss`; waits. InputError where one is not finite.

        Gradients that are not finite are only counted; the first are reported.
        """
        step, iteration = self.session.step, self.session.iteration
        values = step.values(measured)
        for name, value in values.items():
            if not np.isfinite(value):
                raise broken(self.run, f"the {name} at step {iteration} is {value}")
        skipped, _ = step.skipped()
        if skipped and not (self._told or step.skipped_before):
            self._told = True
            self.progress.message(
                f"step {iteration}: {skipped:,} gradients were not finite and "
                "were skipped; metrics.jsonl counts them as skipped_rows"
            )
        return values


class Evaluator:
    """Evaluates the held-out views of a session."""

    def __init__(self, session: Session, clock: Clock, recorder: Recorder) -> None:
        self.session, self.clock, self.recorder = session, clock, recorder
        self.evaluated_at: int | None = None  # step of the latest evaluation of the run
        self.per_view: list[dict[str, Any]] | None = None  # its scores, if this process made it
        self.latest_seconds = max(FIRST_SECONDS, expected_seconds(session.test_views))
        self._all_seconds = 0.0
        self._is_begun = False  # whether the head of the scores was shown

    def is_due(self) -> bool:
        """Whether an evaluation is due after the latest step, by its number and the time so far."""
        options, iteration = self.session.options, self.session.iteration
        if not is_auto(options.eval_every):
            return options.eval_every > 0 and iteration % options.eval_every == 0
        if EVALUATIONS * iteration % options.iterations >= EVALUATIONS:  # not after an eighth
            return False
        return self._all_seconds + self.latest_seconds <= EVALUATION_SHARE * self.clock.elapsed()

    def evaluate(self) -> None:
        """Evaluate and record the metrics, outside of training time, if any view is held out."""
        session, progress = self.session, self.recorder.progress
        if not session.test_views:
            return
        begin = time.perf_counter()
        with self.clock.paused():
            progress.phase("evaluating")
            session.step.release()  # frames of evaluation have other sizes
            result = evaluate_views(
                CurrentRenderer(session.renderer),
                session.model,
                session.options.sh_degree,
                session.test_views,
                predicted=session.predicted(),
            )
            session.step.release()  # their memory is of other sizes than steps need
        self.latest_seconds = time.perf_counter() - begin
        self._all_seconds += self.latest_seconds
        self.evaluated_at, self.per_view = session.iteration, result.pop("per_view")
        self.recorder.log("eval", **result)
        progress.message("\n".join(self._lines(result)))

    def _lines(self, result: dict[str, Any]) -> Iterator[str]:
        """An evaluation in columns, in at most 79 characters; above the first of this process a
        head."""
        key = main_key(result)
        if not self._is_begun:
            self._is_begun = True
            yield (
                f"scores of {result['views']} held-out photo{'s' * (result['views'] != 1)}"
                + ", their colours fitted, as exposures are learned" * (key == "psnr_cc")
            )
            yield f"{'step':>7}{'PSNR, dB':>10}{'SSIM':>9}{'gaussians':>13}{'training':>11}"
        ssim = result[key.replace("psnr", "ssim")]
        note = disturbed(self.recorder.upheavals, self.session.iteration)
        yield (
            f"{self.session.iteration:>7}{result[key]:>10.2f}{ssim:>9.4f}"
            f"{self.session.model.count:>13,}{self.clock.trained():>9.1f} s  {note}"
        ).rstrip()


def broken(run: RunFolder, what: str, cure: str = "lower the learning rates or check the scene") -> InputError:
    """The InputError of a training that cannot go on."""
    kept = "the last checkpoint is kept" if run.has_checkpoint else "there is no checkpoint yet"
    return InputError(f"{run.path}: {what}; {kept}: {cure}")
