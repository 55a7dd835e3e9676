"""`clsplat.train`: train a model of a scene."""

import tempfile
from collections.abc import Callable, Iterable
from os import PathLike
from pathlib import Path
from typing import Any

from clsplat.api.device import opened_device
from clsplat.api.run import Run
from clsplat.device import Device as OpenedDevice
from clsplat.device import choose_device
from clsplat.errors import Interrupted
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.scene import Scene
from clsplat.training import loop


def train(scene: Scene | str | PathLike[str], output: str | PathLike[str] | None = None, *,
          device: OpenedDevice | None = None, overwrite: bool = False,
          callbacks: Iterable[Callable[[dict[str, Any]], object]] = (), **options: Any) -> Run:
    """Train gaussians on a scene; the same as `clsplat train`.

    Parameters
    ----------
    scene : a Scene as it was read (the option `downscale` makes its photos smaller), or its path.
    output : the folder of the run; None: a new one in the folder for temporary files.
    device : an open device; None: the best one that works.
    overwrite : whether a run in the folder is replaced.
    callbacks : functions that are called with each record, a dict with `event`, `iteration`,
        `train_seconds`, `level` and `gaussians`. Every step has a record of event "step" with its
        `loss`, `l1` and `ssim`, for which the host waits for the device. Other events are those of
        metrics.jsonl: "plan", "level", "grow", "eval". A function that raises
        `clsplat.StopTraining` ends the training after the step; `Run.resume` continues it.
    options : those of `clsplat train --help-all` but `device`, with underscores: iterations=7000,
        sh_degree=2.

    Returns
    -------
    The Run.

    Raises
    ------
    clsplat.ClsplatError : if the scene, an option or the folder cannot be used.
    """
    chosen = resolve({}, options)
    data = scene if isinstance(scene, Scene) else read_scene(Path(scene).absolute(),
                                                                  chosen.images)
    opened = opened_device(device) if device else choose_device("auto", form=chosen.form)
    # absolute, as a callback may change the current folder
    folder = Path(output or tempfile.mkdtemp(prefix="clsplat-run-")).absolute()
    with RunFolder(folder).locked():
        run = RunFolder.create(folder, overwrite=overwrite)
        try:
            loop.train(data, chosen, opened, run, callbacks=callbacks)
        except Interrupted as error:
            if not error.planned:
                raise
    return Run(run)
