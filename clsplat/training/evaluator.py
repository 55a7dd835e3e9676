"""Evaluates the held-out views during a training, and decides when that is due."""

import time
from collections.abc import Iterator
from typing import Any

from clsplat.config.option import is_auto
from clsplat.evaluation.views import METRICS, evaluate_views, final_metrics
from clsplat.report.scores import disturbed, main_key
from clsplat.training.clock import Clock
from clsplat.training.recorder import Recorder
from clsplat.training.session import Session

EVALUATIONS = 8  # in a run, by default
EVALUATION_SHARE = 1 / 3  # of the time so far that evaluations may take


class Evaluator:
    """Evaluates a session.

    Attributes
    ----------
    evaluated_at : step of the last evaluation of the run, or None.
    per_view : scores of its views, if this process made it.
    final_metrics : of the last evaluation, which has time for more.
    latest_seconds : its duration.
    """

    def __init__(self, session: Session, clock: Clock, recorder: Recorder) -> None:
        self.session, self.clock, self.recorder = session, clock, recorder
        self.final_metrics = final_metrics(session.options.lpips)
        self.evaluated_at: int | None = None
        self.per_view: list[dict[str, Any]] | None = None
        self.latest_seconds = self._all_seconds = 0.0
        self._is_begun = False  # whether the head of the scores was shown

    def is_due(self) -> bool:
        """Whether an evaluation is due after the latest step, by its number and the time so far."""
        options, iteration = self.session.options, self.session.iteration
        if not is_auto(options.eval_every):
            return options.eval_every > 0 and iteration % options.eval_every == 0
        if EVALUATIONS * iteration % options.iterations >= EVALUATIONS:  # not after an eighth
            return False
        return (self._all_seconds + self.latest_seconds
                <= EVALUATION_SHARE * self.clock.elapsed())

    def evaluate(self, final: bool = False) -> None:
        """Evaluate and record the metrics, outside of training time, if any view is held out.

        Parameters
        ----------
        final : whether this is the last evaluation, by `final_metrics`.
        """
        session, progress = self.session, self.recorder.progress
        if not session.test_views:
            return
        begin = time.perf_counter()
        with self.clock.paused():
            progress.phase("evaluating")
            session.step.release()  # frames of evaluation have other sizes
            result = evaluate_views(session.renderer, session.model.current_rows(),
                                    session.options.sh_degree, session.test_views,
                                    metrics=self.final_metrics if final else METRICS,
                                    predicted=session.predicted())
            session.device.trim()
        self.latest_seconds = time.perf_counter() - begin
        self._all_seconds += self.latest_seconds
        self.evaluated_at, self.per_view = session.iteration, result.pop("per_view")
        self.recorder.log("eval", **result)
        progress.message("\n".join([*self._head(result), self._line(result)]))

    def _head(self, result: dict[str, Any]) -> Iterator[str]:
        """The lines above the first evaluation of this process, which explain its columns."""
        if self._is_begun:
            return
        self._is_begun = True
        fitted = main_key(result) == "psnr_cc"
        yield (f"scores of {result['views']} held-out photo{'s' * (result['views'] != 1)}"
               + ", their colours fitted, as exposures are learned" * fitted)
        yield f"{'step':>7}{'PSNR, dB':>10}{'SSIM':>9}{'gaussians':>13}{'training':>11}"

    def _line(self, result: dict[str, Any]) -> str:
        """An evaluation in columns, in at most 79 characters."""
        key = main_key(result)
        ssim = result[key.replace("psnr", "ssim")]
        note = ", ".join(f"{name.upper()} {result[name]:.4f}" for name in ("flip", "lpips")
                         if name in result) or disturbed(self.recorder.upheavals,
                                                         self.session.iteration)
        return (f"{self.session.iteration:>7}{result[key]:>10.2f}{ssim:>9.4f}"
                f"{self.session.model.count:>13,}{self.clock.trained():>9.1f} s  {note}").rstrip()
