"""Begins a training in a run folder, or goes on with the one that is there."""

import dataclasses
import logging
from collections.abc import Iterable

from clsplat.config.option import checked
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.io.georeference.files import placed
from clsplat.io.runs.run import OPTIONS, RunFolder
from clsplat.io.scenes.read import fingerprint
from clsplat.options import TrainOptions
from clsplat.scene import Scene
from clsplat.training.checkpoint import damaged, saved_gaussians
from clsplat.training.loop import Training
from clsplat.training.part import Part
from clsplat.training.progress import SilentProgress, Watcher
from clsplat.training.recorder import Callback


def train(
    scene: Scene,
    options: TrainOptions,
    device: Device,
    run: RunFolder,
    progress: SilentProgress | None = None,
    callbacks: Iterable[Callback] = (),
    watcher: Watcher | None = None,
    parts: Iterable[Part] = (),
) -> None:
    """Train a scene from the start, in the folder of an empty `run`.

    `callbacks` are called with every record, and may raise StopTraining; the `watcher` is asked
    after every step. `parts` are those besides what the options ask for; one with the name of
    another takes its place. Raises Interrupted on Ctrl-C, or where an option or a callback stops
    it; the state is saved.
    """
    Training(scene, options, device, run, progress, None, callbacks, watcher, parts=parts).take()


def resumed(
    scene: Scene,
    options: TrainOptions,
    device: Device,
    run: RunFolder,
    progress: SilentProgress | None = None,
    callbacks: Iterable[Callback] = (),
    watcher: Watcher | None = None,
    parts: Iterable[Part] = (),
) -> Training:
    """A run from its checkpoint, as if it had never stopped; arguments as for `train`."""
    record, scene = run.read_options(), placed(scene, run.path)
    if record.get("fingerprint") != fingerprint(scene):
        raise InputError(
            f"{run.path}: this run was trained on another scene, "
            f"{record.get('scene_absolute', record.get('scene'))}; give that one, or "
            "another --output"
        )
    if not (run.has_checkpoint or run.has_model):  # it was killed before its first checkpoint
        (progress.message if progress else logging.getLogger(__name__).warning)(
            f"{run.path}: has no checkpoint, so the training begins again at step 1"
        )
        run.rewind(-1)
        return Training(scene, options, device, run, progress, None, callbacks, watcher, parts=parts)
    match record:  # another version may choose other levels
        case {"decisions": {"levels": [*levels]}} if getattr(options, "levels", None) == ():
            options = dataclasses.replace(
                options, levels=checked(type(options), str(run.path / OPTIONS), "levels", levels)
            )
    arrays, state = run.load_checkpoint()
    if state.get("fingerprint") != record["fingerprint"]:
        raise InputError(
            f"{run.path}: its checkpoint is of another scene; put back the run's own, or start again with --overwrite"
        )
    gaussians = saved_gaussians(run, record, arrays)
    try:
        training = Training(scene, options, device, run, progress, gaussians, callbacks, watcher, state["level"], parts)
        training.checkpoint.load(arrays, state)
    except KeyError as error:
        raise damaged(run, error) from None
    run.rewind(training.session.iteration)
    run.note_scene(scene.path)
    training.evaluator.evaluated_at = max(
        (record["iteration"] for record in run.records() if record.get("event") == "eval"), default=None
    )
    return training


def training_of(
    scene: Scene,
    options: TrainOptions,
    device: Device,
    run: RunFolder,
    progress: SilentProgress | None = None,
    callbacks: Iterable[Callback] = (),
    parts: Iterable[Part] = (),
) -> Training:
    """The training that goes on with a run, or begins in a new folder; arguments as for `train`."""
    if run.is_begun:
        return resumed(scene, options, device, run, progress, callbacks, parts=parts)
    run.begin_new()
    return Training(scene, options, device, run, progress, callbacks=callbacks, parts=parts)
