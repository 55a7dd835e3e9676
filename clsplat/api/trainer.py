"""`clsplat.train`, and `clsplat.Trainer`: a training whose steps are taken one by one."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from clsplat.api.device import opened_device
from clsplat.api.gaussians import Gaussians
from clsplat.api.options import TrainOptions, resolved
from clsplat.api.renderer import checked_fields
from clsplat.api.run import Run
from clsplat.device import Device, choose_device
from clsplat.errors import InputError, Interrupted
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.scene import Scene
from clsplat.schedule.plan import Schedule
from clsplat.training import loop
from clsplat.training.interrupt import deferred_interrupt
from clsplat.training.part import Part
from clsplat.training.recorder import Callback


def train(
    scene: Scene | str | PathLike[str],
    options: TrainOptions | None = None,
    *,
    output: str | PathLike[str] | None = None,
    device: Device | None = None,
    parts: Iterable[Part] = (),
    schedule: type[Schedule] | None = None,
    overwrite: bool = False,
    callbacks: Iterable[Callback] = (),
) -> Run:
    """Train gaussians on a scene; the same as `clsplat train`.

    Parameters
    ----------
    scene, options, output, device, parts, schedule, overwrite, callbacks : as for Trainer.

    Returns
    -------
    The Run.

    Raises
    ------
    clsplat.ClsplatError : if the scene, an option or the folder cannot be used.
    """
    trainer = Trainer(
        scene,
        options,
        output=output,
        device=device,
        parts=parts,
        schedule=schedule,
        overwrite=overwrite,
        callbacks=callbacks,
    )
    try:
        with trainer._training.resumable():
            trainer._end()
    except Interrupted as error:
        if not error.planned:
            raise
    return trainer.run


class Trainer:
    """An iterator over the steps of a training: `for step in clsplat.Trainer(scene): step.loss`.

    After the last step the run is finished as by `clsplat.train`. A loop that is left earlier may
    be entered again, and goes on with the next step; `save` writes a checkpoint, from which
    `Run.resume` goes on in another process. Ctrl-C ends the step and saves.

    Parameters
    ----------
    scene : a Scene as it was read (the option `downscale` makes its photos smaller), or its path.
    options : of the training; None: the defaults.
    output : the folder of the run; None: a new one in the folder for temporary files.
    device : an open device; None: the best one that works.
    parts : terms of the loss and whatever else is learned beside the gaussians, besides what the
        options ask for; one with the name of another takes its place.
    schedule : a class that decides levels and growth; None: the one that the options name.
    overwrite : whether a run in the folder is replaced.
    callbacks : functions that are called with each record, a dict with `event`, `iteration`,
        `train_seconds`, `level` and `gaussians`. Every step has a record of event "step" with its
        `loss`, `l1` and `ssim`, for which the host waits for the device. Other events are those of
        metrics.jsonl: "plan", "level", "grow", "eval". A function that raises
        `clsplat.StopTraining` ends the training after the step; `Run.resume` continues it.

    Attributes
    ----------
    run : the Run.
    iteration : number of the latest step; 0 before the first.

    Raises
    ------
    clsplat.ClsplatError : if the scene, an option or the folder cannot be used.
    """

    def __init__(
        self,
        scene: Scene | str | PathLike[str],
        options: TrainOptions | None = None,
        *,
        output: str | PathLike[str] | None = None,
        device: Device | None = None,
        parts: Iterable[Part] = (),
        schedule: type[Schedule] | None = None,
        overwrite: bool = False,
        callbacks: Iterable[Callback] = (),
    ) -> None:
        data, chosen, opened = opened_training(scene, options, device, schedule)
        folder = folder_of(output)
        with ExitStack() as opening:
            opening.enter_context(RunFolder(folder).locked())
            run = RunFolder.create(folder, overwrite=overwrite)
            self._training = loop.Training(data, chosen, opened, run, parts=parts, callbacks=callbacks)
            opening.callback(self._training.session.photos.close)
            self._training.record()
            self._open = opening.pop_all()
        self.run = Run(run)
        self._is_closed = False

    @property
    def iteration(self) -> int:
        """Number of the latest step; 0 before the first."""
        return self._training.session.iteration

    @property
    def model(self) -> Gaussians:
        """The gaussians after the latest step, in host memory; waits for the device."""
        session = self._training.session
        model = session.model.download().scaled(session.scene.unit)
        return Gaussians.of(model.located(session.scene.offset))

    def update(self, **fields: Any) -> None:
        """Replace parameters of the gaussians; the moments of Adam stay.

        Parameters
        ----------
        fields : as for `Renderer.update`, in the coordinates of `model`.

        Raises
        ------
        clsplat.ClsplatError : for an unknown field, or one of another shape.
        """
        session = self._training.session
        model, unit = session.model, session.scene.unit
        model.catch_up()
        for name, values in checked_fields(fields, model.count, model.sh_degree).items():
            if name == "positions":
                values = values / np.float32(unit)
            elif name == "log_scales":
                values = values - np.float32(np.log(unit))
            model.write(name, values)

    def __iter__(self) -> Trainer:
        return self

    def __next__(self) -> TrainingStep:
        training = self._training
        if self._is_closed:
            raise StopIteration
        if training.finished() or training.stops():
            self._end()
            raise StopIteration
        with deferred_interrupt() as interrupted:
            training.take_step()
            if interrupted():
                training.save()
                self.close()
                raise training.stopped()
        return TrainingStep(self, training)

    def save(self) -> None:
        """Write a checkpoint into the run's folder."""
        self._training.save()

    def close(self) -> None:
        """Give the folder and the memory of photos free; no step follows. What was saved stays."""
        self._is_closed = True
        self._open.close()

    def _end(self) -> None:
        try:
            self._training.run_to_end()
        finally:
            self.close()

    def __enter__(self) -> Trainer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<clsplat.Trainer: step {self.iteration} of {self._training.session.options.iterations}>"


class TrainingStep:
    """A step of a Trainer, until the next one.

    Attributes
    ----------
    iteration : its number, from 1.
    level : by which the photos were downscaled.
    gaussians : how many there are after it.
    """

    def __init__(self, trainer: Trainer, training: loop.Training) -> None:
        self._trainer, self._training = trainer, training
        self.iteration, self.level = trainer.iteration, training.session.level
        self.gaussians = training.session.step.count

    @property
    def values(self) -> dict[str, float]:
        """The loss and its terms, by name, as in metrics.jsonl; waits for the device."""
        self._check_latest()
        return self._training.latest_values()

    @property
    def loss(self) -> float:
        """The loss; waits for the device."""
        return self.values["loss"]

    @property
    def model(self) -> Gaussians:
        """The gaussians after it, in host memory; waits for the device."""
        self._check_latest()
        return self._trainer.model

    def _check_latest(self) -> None:
        if self._trainer.iteration != self.iteration:
            raise InputError(
                f"step {self.iteration}: the training has gone on; read what you need before the next step"
            )

    def __repr__(self) -> str:
        return f"<clsplat.TrainingStep {self.iteration}: {self.gaussians:,} gaussians>"


def opened_training(
    scene: Scene | str | PathLike[str],
    options: TrainOptions | None,
    device: Device | None,
    schedule: type[Schedule] | None,
) -> tuple[Scene, Any, Device]:
    """The scene, the resolved options and the open device; arguments as for Trainer."""
    chosen = resolved(options, schedule)
    data = scene if isinstance(scene, Scene) else read_scene(Path(scene).absolute(), chosen.images)
    opened = opened_device(device) if device else choose_device(chosen.device, form=chosen.form)
    return data, chosen, opened


def folder_of(output: str | PathLike[str] | None) -> Path:
    """The folder of a result, absolute, as the program may change the current one; None: a new one
    in the folder for temporary files."""
    return Path(output or mkdtemp(prefix="clsplat-run-")).absolute()
