"""A training on disk, finished or not: the object through which every reader of runs goes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device, choose_device
from clsplat.errors import InputError, Interrupted
from clsplat.evaluation.score import Score
from clsplat.evaluation.views import evaluate_run, opened
from clsplat.gaussians import Gaussians
from clsplat.io.ply import read_ply
from clsplat.io.run import RunFolder
from clsplat.io.scenes import fingerprint, read_scene
from clsplat.options import TrainOptions, resolve
from clsplat.scene import Scene


def shown(model: Gaussians, path: Path) -> Gaussians:
    """The model that was read from `path`, if pictures of it would show anything."""
    if not model.count:
        raise InputError(f"{path}: holds no gaussians, so there is nothing to show; give another "
                         "model")
    return model


def to_render(path: Path, scene_path: Path | None) -> tuple[Gaussians, Scene, TrainOptions]:
    """What `clsplat render` shows.

    Parameters
    ----------
    path : a run's folder, or a PLY file.
    scene_path : of any scene whose cameras to use; None: the run's own.

    Returns
    -------
    The model, the scene at the size to render at, and how it is rendered.

    Raises
    ------
    clsplat.ClsplatError : where the run is not finished, or nobody names the cameras of a PLY file.
    """
    if path.is_dir():
        run = Run.open(path)
        options, model = run.options, run.finished_model
        place, images = run.folder.scene_path(scene_path), options.images
        scene = read_scene(place, images if scene_path is None or (place / images).is_dir() else "")
    elif scene_path is None:
        raise InputError(f"{path}: a PLY file has no cameras; name them with --scene SCENE")
    else:
        options, scene = TrainOptions(max_resolution=0), read_scene(scene_path)
        model = read_ply(path, scene.offset)
    return shown(model, path), scene.reduced(options.downscale, options.max_resolution), options


class Run:
    """A run folder, as `clsplat train` and `clsplat.train` write it; use `Run.open`.

    Attributes
    ----------
    path : its folder.
    folder : what reads and writes its files.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder
        self.path: Path = folder.path

    @classmethod
    def open(cls, path: str | Path) -> Run:
        """The run in a folder.

        Parameters
        ----------
        path : the folder.

        Raises
        ------
        clsplat.ClsplatError : where the folder holds no run.
        """
        return cls(RunFolder.open(path))

    @property
    def options(self) -> TrainOptions:
        """What the run was trained with, every option as resolved."""
        record, known = self.record, TrainOptions.__dataclass_fields__
        return resolve({key: value for key, value in record.items() if key in known}, {})

    @property
    def record(self) -> dict[str, Any]:
        """options.json as it was written: the options, and facts such as the device."""
        found: dict[str, Any] = self.folder.read_options()
        return found

    @property
    def is_finished(self) -> bool:
        """Whether all its steps are taken and its report is written."""
        return self.folder.is_finished

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """The records of metrics.jsonl, each with `event`, `iteration` and `train_seconds`."""
        return list(self.folder.past_records())

    @property
    def model(self) -> Gaussians:
        """Its gaussians: the finished model, or else those of the last checkpoint."""
        if self.folder.has_model:
            return self.finished_model
        from clsplat.training.checkpoint import saved_gaussians

        record = self.record
        found = saved_gaussians(self.folder, record, *self.folder.load_checkpoint())
        try:
            return found.scaled(float(record["extent"])).located(record["offset"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: options.json lacks a good {error}; start again with "
                             "overwrite=True") from None

    @property
    def finished_model(self) -> Gaussians:
        """Its gaussians, once all steps are taken; before, an error that says how to go on."""
        return self.folder.load_model()

    @property
    def exposures(self) -> dict[str, NDArray[np.float64]] | None:
        """Name of a training view -> float64[3, 4], its colour transform; None without any."""
        found: dict[str, NDArray[np.float64]] | None = self.folder.load_exposures()
        return found

    def scene(self, path: str | Path | None = None, *, whole: bool = False) -> Scene:
        """The scene that it was trained on, at the size that it was trained at.

        Parameters
        ----------
        path : where the scene is now; None: where the run has recorded it.
        whole : at the size of its photos instead.

        Raises
        ------
        clsplat.ClsplatError : where it is not there, or is another scene.
        """
        place, options = self.folder.scene_path(None if path is None else Path(path)), self.options
        scene = read_scene(place, options.images)
        wanted = self.record.get("fingerprint")
        if wanted is not None and fingerprint(scene) != wanted:
            raise InputError(f"{place}: is not the scene that {self.path} was trained on; give "
                             "that one with --scene")
        return scene if whole else scene.reduced(options.downscale, options.max_resolution)

    def opened(self, device: Device, scene: Scene, model: Gaussians | None = None
               ) -> tuple[Any, Any, int]:
        """A model on a device, to render views of a scene as the run was trained.

        Parameters
        ----------
        device : an open device.
        scene : whose cameras will render it.
        model : in the scene's frame; None: the finished one.

        Returns
        -------
        The renderer, the device's rows and the SH degree.

        Raises
        ------
        clsplat.ClsplatError : where the model holds nothing to show.
        """
        model = shown(model or self.finished_model, self.path)
        renderer, rows, degree = opened(device, model, scene, self.options)
        return renderer, rows, degree

    def resume(self, *, device: Device | None = None,
               callbacks: Iterable[Callable[[dict[str, Any]], object]] = ()) -> None:
        """Go on with a training that was stopped, from its last checkpoint to its end.

        Parameters
        ----------
        device : an open device; None: what the run's option says.
        callbacks : as for `clsplat.train`.

        Raises
        ------
        clsplat.ClsplatError : where its scene is gone or its checkpoint is damaged.
        """
        from clsplat.training.loop import resume

        options = replace(self.options, stop_at=0)
        device = device or choose_device(options.device, form=options.form)
        with self.folder.locked():
            try:
                resume(self.scene(whole=True), options, device, self.folder, callbacks=callbacks)
            except Interrupted as error:
                if not error.planned:
                    raise

    def evaluate(self, device: Device | None = None) -> Score:
        """Compare the finished model with the held-out photos.

        Parameters
        ----------
        device : an open device; None: the best that works.

        Returns
        -------
        The Score.

        Raises
        ------
        clsplat.ClsplatError : where the run has no model or holds out no view.
        """
        if not self.folder.has_model:
            raise InputError(f"{self.path}: has no finished model yet; go on with it first, or "
                             "give Run.model to clsplat.evaluate")
        return Score.of(evaluate_run(self, device or choose_device("auto"), save_images=False))

    def __repr__(self) -> str:
        state = "finished" if self.is_finished else "not finished"
        return f"<clsplat.Run {str(self.path)!r}, {state}>"

    def _repr_html_(self) -> str:
        from clsplat.report.notebook import run_page

        return run_page(self)
