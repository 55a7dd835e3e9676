"""`clsplat.train`: train a model of a scene."""

from collections.abc import Callable, Iterable
from os import PathLike
from typing import Any

from clsplat.api.options import TrainOptions
from clsplat.api.run import Run
from clsplat.api.trainer import folder_of, opened_training
from clsplat.device import Device
from clsplat.errors import Interrupted
from clsplat.io.runs.run import RunFolder
from clsplat.scene import Scene
from clsplat.schedule.plan import Schedule
from clsplat.training import loop
from clsplat.training.part import Part


def train(scene: Scene | str | PathLike[str], options: TrainOptions | None = None, *,
          output: str | PathLike[str] | None = None, device: Device | None = None,
          parts: Iterable[Part] = (), schedule: type[Schedule] | None = None,
          overwrite: bool = False, callbacks: Iterable[Callable[[dict[str, Any]], object]] = ()
          ) -> Run:
    """Train gaussians on a scene; the same as `clsplat train`.

    Parameters
    ----------
    scene, options, output, device, parts, schedule, overwrite : as for `clsplat.Trainer`.
    callbacks : functions that are called with each record, a dict with `event`, `iteration`,
        `train_seconds`, `level` and `gaussians`. Every step has a record of event "step" with its
        `loss`, `l1` and `ssim`, for which the host waits for the device. Other events are those of
        metrics.jsonl: "plan", "level", "grow", "eval". A function that raises
        `clsplat.StopTraining` ends the training after the step; `Run.resume` continues it.

    Returns
    -------
    The Run.

    Raises
    ------
    clsplat.ClsplatError : if the scene, an option or the folder cannot be used.
    """
    data, chosen, opened = opened_training(scene, options, device, schedule)
    folder = folder_of(output)
    with RunFolder(folder).locked():
        run = RunFolder.create(folder, overwrite=overwrite)
        try:
            loop.train(data, chosen, opened, run, callbacks=callbacks, parts=parts)
        except Interrupted as error:
            if not error.planned:
                raise
    return Run(run)
