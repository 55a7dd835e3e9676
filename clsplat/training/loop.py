"""The training loop: steps, growth, evaluations, metrics, checkpoints; it can be stopped anywhere.

Randomness is counter-based (seed and iteration), so a checkpoint needs no generator state and a
resumed run ends in the same bytes as one that was never stopped.
"""

import dataclasses
import functools
import shlex
import time
from contextlib import contextmanager

import numpy as np

from clsplat.errors import ClsplatError, InputError, Interrupted
from clsplat.evaluation.views import evaluate_views
from clsplat.gaussians import mean_inverse_distance
from clsplat.io.scenes import fingerprint
from clsplat.loss.exposure import Exposures
from clsplat.loss.image_loss import loss_value
from clsplat.partition.blocks import seen_pixels, trainable
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule import Subject, scaled_steps, schedule_of
from clsplat.training import checkpoint
from clsplat.training.adjacent import Adjacent
from clsplat.training.begin import initial_exposures, initial_gaussians
from clsplat.training.callbacks import Callbacks
from clsplat.training.clock import Clock
from clsplat.training.finish import draw_report, save_model
from clsplat.training.frequency import scene_frequency
from clsplat.training.interrupt import deferred_interrupt, was_interrupted
from clsplat.training.model import Model
from clsplat.training.needs import find_needs, smallest_size
from clsplat.training.photos import Photos, decoded, epoch_order, size_note
from clsplat.training.silent import WARNING, Silent
from clsplat.training.skipped import TOO_MANY
from clsplat.training.snapshots import save_snapshot
from clsplat.training.step import Step, TrainingSample
from clsplat.training.warn import find_warnings

REPORT_EVERY = 50  # steps between progress lines; each waits for the device
LOG_EVERY = 100
LOOK_VIEWS = 10  # that a schedule may look at before it grows


def train(scene, options, device, run, progress=None, callbacks=()):
    """Train `scene` from the start into an empty `run` folder.

    options: TrainOptions; progress: called as progress(iteration=, total=, loss=, gaussians=,
    memory_bytes=, level=) and progress.message(text); callbacks: see `callbacks.Callbacks`. Raises
    Interrupted, state saved, on Ctrl-C, and where a callback stops it.
    """
    training = Training(scene, options, device, run, progress, callbacks=callbacks)
    with training.resumable():
        found = find_warnings(training.scene, training.train_views,
                              training.step.model.rows["opacity_logits"].download())
        run.write_options({"scene": scene.path, **dataclasses.asdict(options),
                           "fingerprint": training.fingerprint, "opencl_device": device.name,
                           "kernel_form": device.form, "extent": scene.extent,
                           "offset": scene.offset.tolist(), "needs": training.needs.found})
        training.recorded = True
        training.begin(found)
        training.run_to_end()


def resume(scene, options, device, run, progress=None, callbacks=()):
    """Go on from the run's checkpoint, as if it had never stopped."""
    record = run.read_options()
    if record.get("fingerprint") != fingerprint(scene):
        raise InputError(f"{run.path}: this run was trained on another scene, "
                         f"{record.get('scene_absolute', record.get('scene'))}; give that one, or "
                         "another --output")
    if not (run.has_checkpoint or run.has_model):  # it was killed before its first checkpoint
        run.rewind(-1)
        train(scene, options, device, run, progress, callbacks)
        return
    arrays, state = run.load_checkpoint()
    if state.get("fingerprint") != record["fingerprint"]:
        raise InputError(f"{run.path}: its checkpoint is of another scene; put back the run's own, "
                         "or start again with --overwrite")
    gaussians = checkpoint.saved_gaussians(
        run, {"sh_degree": options.sh_degree, **record}, arrays, state)
    try:
        training = Training(scene, options, device, run, progress, gaussians, callbacks)
        checkpoint.load(training, arrays, state)
    except KeyError as error:
        raise InputError(f"{run.path}: its checkpoint lacks {error}; "
                         "start again with --overwrite") from None
    run.rewind(training.iteration)
    run.note_scene(scene.path)
    training.evaluated_at = max((record["iteration"] for record in run.past_records()
                                 if record.get("event") == "eval"), default=None)
    with training.resumable():
        training.run_to_end()


class Training(Clock):
    """The state of a run: what `take_step` changes and a checkpoint holds.

    gaussians: where a resumed run goes on; None begins as the options say.
    """

    def __init__(self, scene, options, device, run, progress, gaussians=None, callbacks=()):
        super().__init__(device)
        device.peak_bytes = 0  # of this run: a city may train several on one device
        self.iteration = 0
        self.evaluated_at = self.per_view = self.level = self.losses = None
        self.recorded = gaussians is not None  # whether the run folder holds this run
        self.fingerprint = fingerprint(scene)
        self.run, self.progress = run, progress or Silent()
        self.callbacks = Callbacks(callbacks)
        note = size_note(scene.views, options)
        if note and not (options.coarse or scene.region):  # a city says it once, for all
            self.progress.message(note)
        scene = scene.reduced(options.downscale, options.max_resolution)
        self.scene = scene = scene.normalised()  # same steps whatever the unit of the scene
        if len(scene.views) < 2:
            raise InputError(f"{scene.name}: has a single photo; depth needs at least two from "
                             "different places, and 20 or more make a good model")
        self.train_views, self.test_views = scene.split(options.test_every)
        if not self.train_views:
            raise InputError(f"{scene.name}: --test-every {options.test_every} holds out every "
                             "view; use a larger number, or none")
        self.progress.phase("planning")
        self.needs = find_needs(scene, self.train_views, scaled_steps(options), device)
        self.options = options = self.needs.options
        initial = gaussians or initial_gaussians(scene, options)
        trains = functools.partial(trainable, scene) if scene.region else None
        growing = (int(trains(initial.positions, initial.log_scales).sum()) if trains
                   else initial.count)
        views = self.train_views
        self.schedule = schedule_of(options.schedule)(options, Subject(
            smallest_size(views), growing, mean_inverse_distance(scene.points) / scene.unit,
            lambda: decoded(views), seen_pixels(scene, views)))
        near = options.near / scene.unit or scene.near_plane
        self.renderer = Renderer(device, options.sh_degree, near,
                                 options.antialiased, options.background)
        model = Model(device, initial, options.engine, options.optimizer == "dense")
        exposures = None
        if options.exposure == "on":
            given = initial_exposures(scene, views)  # blocks that learned their own would not agree
            exposures = Exposures(device, len(views), initial=given, learns=given is None)
        self.step = Step(self.renderer, model, scene.extent, options, exposures, trains)
        self.progress.phase("reading photos")
        for _ in decoded(self.test_views):
            pass  # a damaged one would end the run at its evaluation
        self.budget = self.measured_budget() if options.time_budget else None
        self.photos = Photos(device, views, self.schedule.levels)
        self.adjacent = self.needs.neighbours and Adjacent(
            device, self.needs.neighbours, exposures, options.seed)
        self.use_level(self.schedule.levels[0])
        self.progress.phase("compiling kernels")  # of the first step
        self.unpause()

    def view_of(self, number):
        """Index of the number-th view (from 1) that is trained on: shuffled epochs, each view once
        an epoch. A step takes the next options.batch of them."""
        epoch, place = divmod(number - 1, len(self.train_views))
        return epoch_order(self.options.seed, epoch, len(self.train_views))[place]

    def use_level(self, level):
        """Train on images `level` times smaller from now on."""
        if level == self.level:
            return
        self.level = level
        self.progress.phase(f"reading photos of level {level:g}")
        self.photos.use(level)
        if self.budget:
            self.budget.note_change(self.photos.read_seconds, self.iteration, self.stepped())
        cameras = [view.camera for view in self.photos.views]
        if self.adjacent:
            self.adjacent.use(cameras)
        self.cameras = [self.renderer.pack(camera) for camera in cameras]
        self.step.statistics.clear(self.step.model.count)

    def begin(self, found):
        """The first records of a run that starts; found: warnings, as texts for the user."""
        self.unpause()  # no time of training yet
        self.log("plan", reasons=self.needs.reasons, levels=self.schedule.levels)
        for text in found:
            self.log("warning", text=text)
            if self.progress:
                self.progress.message(f"{WARNING}{text}")

    def run_to_end(self):
        """Steps until done, `stop_at` or Ctrl-C, which waits for its step; then saves the state.

        What cannot be made again comes first: the checkpoint, then the finished model, then the
        final evaluation, and the report last, which costs nothing else when it fails.
        """
        self.unpause()
        with deferred_interrupt() as interrupted:
            while not (self.finished() or self.stops() or interrupted() or self.callbacks.stop):
                self.take_step()
                self.report()
                self.callbacks.stepped(self)
                if self.due(self.options.checkpoint_every) and not self.finished():
                    self.save()
            self.save()
            if self.finished():
                save_model(self)
        if not self.finished():
            raise self.stopped()
        if self.evaluated_at != self.iteration:
            self.evaluate()
        draw_report(self)

    @contextmanager
    def resumable(self):
        """What interrupts the block, wherever it is, tells how to go on from the last checkpoint,
        once the run is recorded; photos that were still to be read are not."""
        try:
            yield
        except (Exception, KeyboardInterrupt) as error:
            if isinstance(error, ClsplatError) or not (
                    self.recorded and was_interrupted(error)):
                raise
            raise self.stopped() from None
        finally:
            self.photos.close()

    def stopped(self):
        """The Interrupted of a run that can go on."""
        return Interrupted(f"stopped after step {self.iteration}; go on with: clsplat train "
                           f"--resume -o {shlex.quote(str(self.run.path))}",
                           self.stops() or self.callbacks.stop)

    def finished(self):
        """Whether all steps are taken, or all time is spent."""
        return self.iteration >= self.options.iterations

    def stops(self):
        return 0 < self.options.stop_at <= self.iteration

    def take_step(self):
        """One step with what follows it, and its evaluation where one is due."""
        iteration = self.iteration + 1
        plan = self.allowed(self.schedule.plan(iteration))
        if self.options.snapshots and plan.level != self.level:
            save_snapshot(self)
        self.use_level(plan.level)
        batch, exposures = self.options.batch, self.step.exposures
        taken = self.iteration * batch
        if exposures and taken % len(self.train_views) < batch:  # an epoch has ended
            exposures.recentre()
            if self.adjacent:
                self.adjacent.compare_colours()
        self.losses = self.step.run(iteration, plan, (
            self.sample(taken + place, plan.regularises) for place in range(1, batch + 1)))
        self.progress.phase(f"training level {plan.level:g}")
        event = self.step.densify(iteration, plan, self.schedule, self.scoring_views)
        self.iteration = iteration
        if not self.step.model.count:
            raise self.broken(f"all gaussians were pruned after step {iteration}",
                              "lower --prune-opacity, or allow larger --prune-size or "
                              "--sphere-reach")
        if event:
            self.log("grow", **event)
        self.observe()
        if self.budget and self.budget.is_due(self.stepped()):
            self.estimate_end()
        if self.finished():
            self.end_well()
        elif self.evaluates():  # the last one comes once the model is saved
            self.evaluate()

    def sample(self, number, regularises):
        """The sample of the number-th view; begins to read the photos of the one after it."""
        index = self.view_of(number)
        photo = self.photos[index]
        if not self.photos.resident:
            following = self.view_of(number + 1)
            self.photos.expect(following)
            if regularises:
                self.photos.expect(self.adjacent.drawn(number + 1, following)[1])
        pair = self.pair(number, index) if regularises else None
        return TrainingSample(index, self.cameras[index], photo, pair)

    def pair(self, number, index):
        """What a TrainingSample of view `index` is compared with, or None."""
        row, other = self.adjacent.drawn(number, index)
        return None if row is None else (
            self.photos[other], self.adjacent.geometries, self.adjacent.colours, row)

    def scoring_views(self):
        """[(packed camera, photo), ...]: some training views, others at each step."""
        rng = np.random.default_rng([self.options.seed, 3, self.iteration])
        count = len(self.train_views)
        chosen = rng.choice(count, min(LOOK_VIEWS, count), replace=False)
        return [(self.cameras[i], self.photos[i]) for i in chosen]

    def observe(self):
        """Show the schedule the scene frequency where it looks; log what it decides."""
        self.frequency = None
        if not (self.due(LOG_EVERY) or self.due(self.schedule.observe_every)):
            return
        self.frequency = scene_frequency(self.device, self.step.model.rows,
                                         self.scene.unit)
        if self.due(self.schedule.observe_every):
            decision = self.schedule.observe(self.iteration, self.frequency)
            if decision:
                self.log("level", **decision)

    def due(self, every):
        return every > 0 and self.iteration % every == 0

    # --- records

    def place(self):
        """What every record says of where the training is."""
        return {"iteration": self.iteration, "train_seconds": round(self.trained(), 3),
                "wall_seconds": round(self.elapsed(), 3), "level": self.level,
                "gaussians": self.step.model.count}

    def log(self, event, **values):
        """One record of metrics.jsonl; its first keys are those of every record."""
        record = {"event": event, **self.place(), "pixel_pairs": self.step.pixel_pairs,
                  "kernel_bytes": self.moved(), **values}
        self.run.log(record)
        self.callbacks.logged(record)

    def report(self):
        """The progress line and the step record, where they are due."""
        if not self.due(REPORT_EVERY) and self.iteration > 1:
            return
        loss, l1, ssim = self.check()
        memory = self.device.memory_bytes
        if self.progress:
            self.progress(iteration=self.iteration, total=self.options.iterations, loss=loss,
                          gaussians=self.step.model.count, memory_bytes=memory,
                          level=self.level)
        if self.due(LOG_EVERY) or self.iteration == 1:
            skipped, asked = self.step.skipped.close()
            self.log("step", loss=loss, l1=l1, ssim=ssim, memory_bytes=memory,
                     peak_bytes=self.device.peak_bytes,
                     skipped_rows=self.step.skipped.total, skipped_since=skipped,
                     frequency=self.frequency, convergence=self.schedule.latest)
            if self.iteration > 1 and skipped > TOO_MANY * asked:  # one view alone says little
                raise self.broken(f"{skipped:,} of {asked:,} gradients were not finite in the "
                                  f"{LOG_EVERY} steps to {self.iteration}")

    def check(self):
        """(loss, l1, ssim) of the last step; waits. InputError where the loss is not finite;
        gradients that were not are counted, and the first told of."""
        values = np.mean([loss_value(sums, count, self.options.ssim_weight)
                          for sums, count in self.losses], axis=0).tolist()
        if not np.isfinite(values[0]):
            raise self.broken(f"the loss at step {self.iteration} is {values[0]}")
        skipped = self.step.skipped
        if skipped.poll() and self.progress:
            self.progress.message(f"step {self.iteration}: {skipped.total:,} gradients were not "
                                  "finite and were skipped; metrics.jsonl counts on, as "
                                  "skipped_rows")
        return values

    def broken(self, what, cure="lower the learning rates or check the scene"):
        """The InputError for a training that cannot go on."""
        kept = ("the last checkpoint is kept" if self.run.has_checkpoint
                else "there is no checkpoint yet")
        return InputError(f"{self.run.path}: {what}; {kept}: {cure}")

    def evaluate(self):
        """Metrics of the held-out views, outside of training time."""
        if not self.test_views:
            return
        self.pause()
        self.progress.phase("evaluating")
        begin = time.perf_counter()
        result = evaluate_views(self.renderer, self.step.model.rows, self.options.sh_degree,
                                self.test_views)
        self.unpause()
        self.note_evaluation(time.perf_counter() - begin)
        self.evaluated_at, self.per_view = self.iteration, result["per_view"]
        means = {key: value for key, value in result.items() if key != "per_view"}
        self.log("eval", **means)
        if self.progress:
            self.progress.message(
                f"step {self.iteration}: PSNR {means['psnr']:.2f} dB ({means['psnr_cc']:.2f} after "
                f"the colour fit), SSIM {means['ssim']:.4f}, {means['views']} held-out views, "
                f"{self.step.model.count:,} gaussians, {self.train_seconds:.1f} s of training")

    def save(self):
        """Write the checkpoint, outside of training time; InputError rather than a spoilt one."""
        self.pause()
        self.progress.phase("writing the checkpoint")
        if self.losses:
            self.check()
        begin = time.perf_counter()
        checkpoint.save(self)
        if self.budget:
            self.budget.note_saved(checkpoint.size(self.step.model), time.perf_counter() - begin)
        self.unpause()
