"""The training loop: steps, growth, evaluations and checkpoints; it can be stopped anywhere.

Random numbers depend only on the seed and the iteration, so a checkpoint needs no generator state
and a resumed run ends in the same bytes as one that was never stopped.
"""

import dataclasses
import logging
import shlex
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.option import is_auto
from clsplat.device import Device
from clsplat.errors import ClsplatError, Interrupted, reason
from clsplat.evaluation.pictures import Pictures
from clsplat.evaluation.views import pictures_of
from clsplat.gaussians import Gaussians
from clsplat.io.georeference.files import placement_comments, write_placement
from clsplat.io.models.ply import START, start_comment
from clsplat.io.models.values import mode_comment
from clsplat.io.photos.depth import with_depths
from clsplat.io.photos.undistort import undistorted
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import fingerprint
from clsplat.options import TrainOptions
from clsplat.report.run import write_report
from clsplat.scene import Scene
from clsplat.training.budget import Deadline, evaluation_seconds, saved_a_second
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.current import CurrentRenderer
from clsplat.training.frequency import scene_frequency
from clsplat.training.growth import densify
from clsplat.training.interrupt import deferred_interrupt, was_interrupted
from clsplat.training.part import Part
from clsplat.training.photos import THREADS, size_note
from clsplat.training.progress import WARNING, SilentProgress, Watcher, training_at
from clsplat.training.recorder import LOG_EVERY, Callback, Clock, Evaluator, Recorder, broken
from clsplat.training.start.begin import begin, trained_on
from clsplat.training.start.prepare import find_warnings, is_stage, prepare
from clsplat.training.step import Measured

SAVE_SECONDS = 30.0  # between checkpoints: so much work a kill may cost
SAVE_SHARE = 1 / 20  # of the time, at most, that checkpoints take


class Training:
    """Runs a session to its end; arguments as for `train`, with gaussians and level of a resumed
    run. `recorded` : whether the run folder contains this run."""

    def __init__(
        self,
        scene: Scene,
        options: TrainOptions,
        device: Device,
        run: RunFolder,
        progress: SilentProgress | None = None,
        gaussians: Gaussians | None = None,
        callbacks: Iterable[Callback] = (),
        watcher: Watcher | None = None,
        level: float = 0.0,
        parts: Iterable[Part] = (),
    ) -> None:
        device.peak_bytes = 0  # of this run: a city may train several on one device
        self.recorded = gaussians is not None
        self.is_stage = is_stage(options, parts := tuple(parts))
        self._given, self.run, self.watcher = (scene, options), run, watcher
        self.progress = progress = SilentProgress() if progress is None else progress
        # the larger one shows it once
        if (note := size_note(scene.views, options)) and not self.is_stage:
            progress.message(note)
        if any(view.lens for view in scene.views):
            progress.phase("undistorting photos")
            scene = undistorted(with_depths(scene, options.depth), run.undistorted, THREADS)
        self._scene, self.clock = scene, Clock(device)
        progress.phase("planning")
        prepared = prepare(scene, options, device, parts)
        self.session, self._start_seconds = begin(prepared, device, run.path, progress, gaussians, level)
        self.recorder = Recorder(self.session, self.clock, run, progress, callbacks)
        self.evaluator = Evaluator(self.session, self.clock, self.recorder)
        self.deadline = (
            Deadline(self.session, self.clock, evaluation_seconds(self.session), saved_a_second(run.path))
            if options.time_budget
            else None
        )
        self.checkpoint = Checkpoint(run, self.session, self.clock, self.deadline, fingerprint(scene))
        self._measured: list[Measured] = []  # by the latest step
        progress.phase("compiling kernels")  # of the first step

    def record(self) -> None:
        """Write the options and the first records of a new run, show its warnings, and begin."""
        session, (scene, options) = self.session, self._given
        warnings = list(find_warnings(session.scene, session.prepared.thumbnails, session.step.count))
        session.prepared.thumbnails.forget()
        self.run.write_options(
            {
                **dataclasses.asdict(options),
                **trained_on(scene, options.init, session.device, self.is_stage),
                "decisions": session.decisions.values,
            }
        )
        write_placement(self.run.path, scene, first_view=True)
        self.recorded = True
        self.clock.restart(self._start_seconds)
        self.recorder.log("plan", reasons=session.decisions.reasons, levels=session.schedule.levels)
        for text in warnings:
            self.recorder.log("warning", text=text)
            self.progress.message(f"{WARNING}{text}")
        self.begin()

    def take(self, closes: bool = True) -> None:
        """Begin or go on until the end, or until a stop, which raises Interrupted.

        `closes` : then no more photos are read, and the training cannot go on in this process."""
        with self.resumable(closes):
            (self.begin if self.recorded else self.record)()
            self.run_to_end()

    def run_to_end(self) -> None:
        """Take steps until the end, `stop_at` or Ctrl-C, which waits for its step; then save.

        The checkpoint and then the finished model are written while the final evaluation runs and
        pictures are drawn; last is the report, whose failure does no harm. A stage has neither, and
        once it is finished no checkpoint, which is three times as large as the model.
        """
        with ThreadPoolExecutor(1) as writer:
            with deferred_interrupt() as interrupted:
                while not (self.finished() or self.stops() or interrupted()):
                    self.take_step()
                if not self.finished():
                    self.save()
                elif self.is_stage:
                    self._end_stage()
                else:
                    written = writer.submit(self._files())
            self.recorder.raise_failure()
            if not self.finished() or self.is_stage and interrupted():  # the larger one goes on
                raise self.stopped()
            if not self.is_stage:
                if self.evaluator.evaluated_at != self.session.iteration:
                    self.evaluator.evaluate()
                pictures = None
                with self._harmless("the pictures of its report"):
                    pictures = self._pictures()
                self.progress.phase("writing the model")
                written.result()
                self.recorder.log("time", seconds=self.progress.spent())
                self.progress.phase("writing the report")
                with self._harmless("the report"):
                    write_report(self.run, pictures, self._scene)
        self.recorder.raise_failure()

    def begin(self) -> None:
        """Start the clocks; the first step follows."""
        self.clock.restart()
        self._saved_at, self._save_seconds = self.clock.elapsed(), 0.0
        if self.deadline:
            self.deadline.begin()

    @contextmanager
    def resumable(self, closes: bool = True) -> Iterator[None]:
        """Turn an interrupt in the block into one that tells how to resume, if the run is recorded.

        `closes` : at the end of the block no more photos are read.
        """
        try:
            yield
        except (Exception, KeyboardInterrupt) as error:
            if isinstance(error, ClsplatError) or not (self.recorded and was_interrupted(error)):
                raise
            raise self.stopped() from None
        finally:
            if closes:
                self.session.photos.close()

    def stopped(self) -> Interrupted:
        """The Interrupted of a run that can be resumed, from the checkpoint that there is."""
        step, saved = self.session.iteration, self.run.checkpoint_iteration()
        kept = (
            "; go on with"
            if saved == step
            else f", and saved at step {saved}; go on with"
            if saved
            else ", before its first checkpoint; to begin again"
        )
        return Interrupted(
            f"stopped after step {step}{kept}: clsplat train --resume -o {shlex.quote(str(self.run.path))}",
            self.stops() and self.recorder.failure is None,
        )

    def finished(self) -> bool:
        """Whether all steps are taken, or the time is over."""
        return self.session.iteration >= self.session.options.iterations

    def stops(self) -> bool:
        """Whether an option or a callback stops this process."""
        return 0 < self.session.options.stop_at <= self.session.iteration or self.recorder.stop

    def take_step(self) -> None:
        """Take one step with all that follows it, a checkpoint that is due included."""
        session, deadline = self.session, self.deadline
        step, iteration = session.step, session.iteration + 1
        plan = session.schedule.plan(iteration)
        plan = deadline.allowed(plan) if deadline else plan
        for part in session.parts:
            if values := part.before_step(session, plan):
                self.recorder.log(part.name, **values)
        if session.use_level(plan.level) and deadline:
            deadline.note_change()
        batch = session.options.batch
        if session.iteration * batch % len(session.train_views) < batch:  # an epoch has ended
            session.recentre()
        self._measured = step.run(iteration, plan, session.samples(plan), session.upcoming)
        self.progress.phase(training_at(plan.level))
        grown = densify(step, iteration, plan, session.schedule, session.scoring_views, session.sized_cameras)
        session.iteration = iteration
        if not step.count:
            raise broken(
                self.run,
                f"all gaussians were pruned after step {iteration}",
                "lower prune_opacity, or allow larger prune_size or sphere_reach",
            )
        if grown:
            self.recorder.log("grow", **grown)
        if plan.resets_opacity:
            for part in session.parts:
                part.opacities_reset(session)
            self.recorder.log("reset")
        frequency, decision = self._observe()
        if deadline:
            deadline.estimate()
        if self.finished():  # its evaluation follows the saved model
            session.finish()
        elif self._evaluates():
            self.evaluator.evaluate()
            if deadline:
                deadline.note_evaluated(self.evaluator.latest_seconds)
        self.recorder.stepped(self._measured, frequency)
        if decision:  # after all that belongs to the step, which was taken at the level before
            self.recorder.log("level", **decision)
        if self.watcher and self.watcher.is_due():
            with self.clock.paused():
                self.watcher.draw(session)
        if self._saves() and not self.finished():
            self.save()

    def latest_values(self) -> dict[str, float]:
        """The terms of the loss at the latest step; waits. InputError if one is not finite."""
        return self.recorder.check(self._measured)

    def _observe(self) -> tuple[dict[str, float] | None, dict[str, Any] | None]:
        """The scene frequency, and what the schedule decides by it, if these are due."""
        session, decision = self.session, None
        observes = self._due(session.schedule.observe_every)
        if not (observes or self._due(LOG_EVERY)):
            return None, None
        session.model.catch_up()
        frequency = scene_frequency(session.device, session.model.rows, session.scene.unit)
        if observes:
            decision = session.schedule.observe(session.iteration, frequency)
        return frequency, decision

    def _evaluates(self) -> bool:
        """Whether an evaluation follows the latest step, other than the last."""
        if self.deadline and is_auto(self.session.options.eval_every):
            return self.deadline.evaluates()
        return self.evaluator.is_due()

    def _saves(self) -> bool:
        """Whether a checkpoint follows the latest step, other than the last."""
        every = self.session.options.checkpoint_every
        if not is_auto(every):
            return self._due(every)
        takes = self._save_seconds or self.checkpoint.expected_seconds()
        return self.clock.elapsed() - self._saved_at >= max(SAVE_SECONDS, takes / SAVE_SHARE)

    def _due(self, every: int) -> bool:
        return every > 0 and self.session.iteration % every == 0

    def save(self) -> None:
        """Write the checkpoint, outside of training time; InputError if a value is not finite."""
        with self.clock.paused():
            self.progress.phase("writing the checkpoint")
            self.recorder.check(self._measured)
            begin = time.perf_counter()
            self.checkpoint.save()
            self._save_seconds, self._saved_at = time.perf_counter() - begin, self.clock.elapsed()
            if self.deadline:
                self.deadline.note_saved(self._save_seconds)

    def _end_stage(self) -> None:
        """Write the model of a finished stage, and remove its checkpoint."""
        with self.clock.paused():
            self.recorder.check(self._measured)
            model = self._finished_model()
            self.checkpoint.check_model(model[0])
            self.run.save_model(*model)
            self.recorder.log("end")  # a block has no evaluation that tells its steps
            self.checkpoint.remove()

    def _files(self) -> Callable[[], None]:
        """What writes the last checkpoint and the finished model, both in host memory already."""
        with self.clock.paused():
            self.progress.phase("writing the model")
            self.recorder.check(self._measured)
            saved, model = self.checkpoint.taken(), self._finished_model()

        def write() -> None:
            self.run.save_checkpoint(*saved)
            self.run.save_model(*model)

        return write

    def _finished_model(self) -> tuple[Gaussians, NDArray[np.floating], tuple[str, ...]]:
        """The finished model with offset and comments; writes what its parts have learned."""
        run, session = self.run, self.session
        session.step.settle()
        for part in session.parts:
            part.write(run, session)
        gaussians = session.model.download().scaled(session.scene.unit)
        comments = (
            *start_comment(str(run.read_options().get(START, ""))),
            f"iterations {session.iteration}",
            mode_comment(session.options.antialiased),
            *placement_comments(session.scene.up, session.scene.georeference),
        )
        return gaussians, session.scene.offset, comments

    def _pictures(self) -> Pictures:
        """The pictures of the report."""
        session = self.session
        shown = CurrentRenderer(session.renderer), session.model, session.options.sh_degree
        return pictures_of(
            *shown,
            session.test_views,
            session.corrected(session.train_views),
            self.evaluator.per_view,
            session.predicted(),
        )

    @contextmanager
    def _harmless(self, what: str) -> Iterator[None]:
        """Make a warning of what goes wrong in the block: the model is complete without it."""
        try:
            yield
        except ClsplatError:
            raise
        except Exception as error:  # noqa: BLE001  (no report is worth a model)
            if was_interrupted(error):
                raise
            logging.getLogger(__name__).warning(
                "%s: %s could not be drawn (%s: %s); the model is complete",
                self.run.path,
                what,
                type(error).__name__,
                reason(error),
            )
