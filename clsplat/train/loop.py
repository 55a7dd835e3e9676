"""The training loop: steps, growth, evaluations, metrics, checkpoints; it can be stopped anywhere.

Randomness is counter-based (seed and iteration), so a checkpoint needs no generator state and a
resumed run ends in the same bytes as one that was never stopped.
"""

import dataclasses
import time

import numpy as np

from clsplat.errors import InputError, Interrupted
from clsplat.evaluate.views import evaluate_views
from clsplat.gaussians import FIELDS, Gaussians
from clsplat.io.scenes import fingerprint
from clsplat.loss.image_loss import loss_value
from clsplat.render.pipeline import Renderer
from clsplat.schedule import SCHEDULES, scaled_steps
from clsplat.train.begin import initial_gaussians
from clsplat.train.interrupt import deferred_interrupt
from clsplat.train.model import Model
from clsplat.train.photos import Photos, decoded
from clsplat.train.step import Step

REPORT_EVERY = 50  # steps between progress lines; each waits for the device
LOG_EVERY = 100


def train(scene, options, device, run, progress=None):
    """Train `scene` from the start into an empty `run` folder.

    options: TrainOptions; progress: called as progress(iteration=, loss=, gaussians=,
    memory_bytes=) and progress.message(text). Raises Interrupted, state saved, on Ctrl-C.
    """
    training = Training(scene, options, device, run, progress, initial_gaussians(scene, options))
    run.write_options({"scene": scene.path, **dataclasses.asdict(options),
                       "fingerprint": training.fingerprint, "opencl_device": device.name,
                       "kernel_form": device.form, "extent": scene.extent,
                       "offset": scene.offset.tolist()})
    training.run_to_end()


def resume(scene, options, device, run, progress=None):
    """Go on from the run's checkpoint, as if it had never stopped."""
    record = run.read_options()
    if record.get("fingerprint") != fingerprint(scene):
        raise InputError(f"{run.path}: this run was trained on another scene, "
                         f"{record.get('scene')}; give that one, or another --output")
    arrays, state = run.load_checkpoint()
    if state.get("fingerprint") != record["fingerprint"]:
        raise InputError(f"{run.path}: its checkpoint is of another scene; put back the run's own, "
                         "or start again with --overwrite")
    try:
        gaussians = Gaussians(fields_of(arrays, "row"), options.sh_degree)
        training = Training(scene, options, device, run, progress, gaussians)
        training.load(arrays, state)
    except KeyError as error:
        raise InputError(f"{run.path}: its checkpoint lacks {error}; "
                         "start again with --overwrite") from None
    run.rewind(training.iteration)
    training.run_to_end()


def fields_of(arrays, kind):
    """Field name -> array, of a checkpoint's arrays of one kind: row, m or v."""
    return {field.name: arrays[f"{kind}.{field.name}"] for field in FIELDS}


class Training:
    """The state of a run: what `take_step` changes and a checkpoint holds."""

    def __init__(self, scene, options, device, run, progress, gaussians):
        self.fingerprint = fingerprint(scene)
        self.options = options = scaled_steps(options)
        self.scene = scene = scene.reduced(options.downscale, options.max_resolution)
        self.device, self.run, self.progress = device, run, progress
        self.train_views, self.test_views = scene.split(options.test_every)
        if not self.train_views:
            raise InputError(f"{scene.name}: --test-every {options.test_every} holds out every "
                             "view; use a larger number, or 0")
        self.schedule = SCHEDULES[options.schedule](options)
        self.renderer = Renderer(device, options.sh_degree, options.near or scene.near_plane,
                                 options.antialiased, options.background)
        model = Model(device, gaussians, options.engine, options.optimizer == "dense")
        self.step = Step(self.renderer, model, scene.extent, options)
        self.photos = Photos(device, self.train_views)
        for _ in decoded(self.test_views):
            pass  # a damaged one would end the run at its evaluation
        self.cameras = [self.renderer.pack(view.camera) for view in self.train_views]
        self.iteration = 0
        self.train_seconds = self.wall_seconds = 0.0

    def view_of(self, iteration):
        """Index of the view of a step (from 1): shuffled epochs, each view once an epoch."""
        epoch, place = divmod(iteration - 1, len(self.train_views))
        return np.random.default_rng([self.options.seed, 1, epoch]).permutation(
            len(self.train_views))[place]

    def run_to_end(self):
        """Steps until done, `stop_at` or Ctrl-C, which waits for its step; then saves the state."""
        end = self.options.iterations
        if self.options.stop_at:
            end = min(end, self.options.stop_at)
        self._clock = self._wall = time.perf_counter()
        try:
            with deferred_interrupt() as interrupted:
                while self.iteration < end and not interrupted():
                    self.take_step()
                    self.report()
                    if self.due(self.options.checkpoint_every) and self.iteration < end:
                        self.save()
        finally:
            self.photos.close()
        self.save()
        if self.iteration < end:
            raise Interrupted(f"stopped after step {self.iteration}; go on with: clsplat train "
                              f"{self.scene.path} -o {self.run.path} --resume")
        gaussians = self.step.model.download()
        self.run.save_model(gaussians, self.scene.offset, self.comments())

    def take_step(self):
        """One step with what follows it, and its evaluation where one is due."""
        iteration = self.iteration + 1
        plan = self.schedule.plan(iteration)
        index = self.view_of(iteration)
        photo = self.photos[index]
        if not self.photos.resident:
            self.photos.expect(self.view_of(iteration + 1))
        self.sums = self.step.take(iteration, plan, self.cameras[index], photo)
        self.values = 3 * photo.shape[1] * photo.shape[2]
        event = self.step.follow(iteration, plan)
        self.iteration = iteration
        if event:
            self.log("grow", **event)
        if self.due(self.options.eval_every) or iteration in self.options.eval_at \
                or iteration == self.options.iterations:
            self.evaluate()

    def due(self, every):
        return every > 0 and self.iteration % every == 0

    # --- records

    def log(self, event, **values):
        """One record of metrics.jsonl; its first keys are those of every record."""
        now = time.perf_counter()
        self.run.log({
            "event": event, "iteration": self.iteration,
            "train_seconds": round(self.train_seconds + now - self._clock, 3),
            "wall_seconds": round(self.wall_seconds + now - self._wall, 3), "level": 1.0,
            "gaussians": self.step.model.count, **values})

    def report(self):
        """The progress line and the step record, where they are due."""
        if not self.due(REPORT_EVERY) and self.iteration > 1:
            return
        loss, l1, ssim = loss_value(self.sums, self.values, self.options.ssim_weight)
        if not np.isfinite(loss):
            raise InputError(f"{self.run.path}: the loss at step {self.iteration} is {loss}; the "
                             "last checkpoint is kept: lower the learning rates or check the scene")
        memory = self.device.memory_bytes
        if self.progress:
            self.progress(iteration=self.iteration, loss=loss, gaussians=self.step.model.count,
                          memory_bytes=memory)
        if self.due(LOG_EVERY) or self.iteration == 1:
            skipped = int(self.renderer.skipped.download()[0])
            self.log("step", loss=loss, l1=l1, ssim=ssim, memory_bytes=memory,
                     skipped_rows=skipped)

    def pause(self):
        """Stop the training clock: what follows is not training."""
        self.device.finish()
        self.train_seconds += time.perf_counter() - self._clock

    def unpause(self):
        self._clock = time.perf_counter()

    def evaluate(self):
        """Metrics of the held-out views, outside of training time."""
        if not self.test_views:
            return
        self.pause()
        result = evaluate_views(self.renderer, self.step.model.rows, self.options.sh_degree,
                                self.test_views)
        self.unpause()
        means = {key: value for key, value in result.items() if key != "per_view"}
        self.log("eval", **means)
        if self.progress:
            self.progress.message(
                f"step {self.iteration}: PSNR {means['psnr']:.2f} dB ({means['psnr_cc']:.2f} after "
                f"the colour fit), SSIM {means['ssim']:.4f}, {means['views']} held-out views, "
                f"{self.step.model.count:,} gaussians, {self.train_seconds:.1f} s of training")

    # --- checkpoints

    def save(self):
        """Write the checkpoint, outside of training time."""
        self.pause()
        model, statistics = self.step.model, self.step.statistics
        m, v = model.adam.download(model.count)
        arrays = {f"{kind}.{name}": values for kind, fields in
                  (("row", model.download().rows), ("m", m), ("v", v))
                  for name, values in fields.items()}
        arrays["statistics.grad_norm_sum"] = statistics.grad_norm_sum.download()
        arrays["statistics.seen_count"] = statistics.seen_count.download()
        now = time.perf_counter()
        self.run.save_checkpoint(arrays, {
            "fingerprint": self.fingerprint, "iteration": self.iteration,
            "train_seconds": self.train_seconds,
            "wall_seconds": self.wall_seconds + now - self._wall,
            "skipped_rows": int(self.renderer.skipped.download()[0])})
        self.unpause()

    def load(self, arrays, state):
        """Take over what a checkpoint holds besides the rows."""
        self.step.model.adam.upload(fields_of(arrays, "m"), fields_of(arrays, "v"))
        self.step.statistics.grad_norm_sum.write(arrays["statistics.grad_norm_sum"])
        self.step.statistics.seen_count.write(arrays["statistics.seen_count"])
        self.renderer.skipped.write(np.array([state["skipped_rows"]], np.uint32))
        self.iteration = state["iteration"]
        self.train_seconds, self.wall_seconds = state["train_seconds"], state["wall_seconds"]

    def comments(self):
        """Lines for the PLY header that other tools read."""
        mode = "mip" if self.options.antialiased else "default"
        return (f"iterations {self.iteration}", f"SplatRenderMode: {mode}")
