"""`clsplat.Run`: a training on disk, finished or not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.api.device import best_device
from clsplat.api.score import Score, score_of
from clsplat.device import Device as OpenedDevice
from clsplat.device import choose_device
from clsplat.errors import InputError, Interrupted
from clsplat.evaluation.views import evaluate_run, read_scene_of, run_options
from clsplat.gaussians import Gaussians
from clsplat.io.run import RunFolder
from clsplat.report.notebook import run_page
from clsplat.scene import Scene
from clsplat.train_options import TrainOptions
from clsplat.training import loop
from clsplat.training.checkpoint import saved_gaussians


class Run:
    """A run folder, as `clsplat train` and `clsplat.train` write it; use `Run.open`.

    Attributes
    ----------
    path : its folder.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
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
        return run_options(self._folder)

    @property
    def is_finished(self) -> bool:
        """Whether all its steps are taken and its report is written."""
        return self._folder.is_finished

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """The records of metrics.jsonl, each with `event`, `iteration` and `train_seconds`."""
        return list(self._folder.past_records())

    @property
    def model(self) -> Gaussians:
        """Its gaussians: the finished model, or else those of the last checkpoint."""
        if self._folder.has_model:
            return self._folder.load_model()
        record = self._folder.read_options()
        found = saved_gaussians(self._folder, record, *self._folder.load_checkpoint())
        try:
            return found.scaled(float(record["extent"])).located(record["offset"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: options.json lacks a good {error}; start again with "
                             "overwrite=True") from None

    def scene(self, path: str | Path | None = None) -> Scene:
        """The scene that it was trained on, at the size that it was trained at.

        Parameters
        ----------
        path : where the scene is now; None: where the run has recorded it.

        Raises
        ------
        clsplat.ClsplatError : where it is not there, or is another scene.
        """
        options = self.options
        whole = read_scene_of(self._folder, None if path is None else Path(path))
        return whole.reduced(options.downscale, options.max_resolution)

    def resume(self, *, device: OpenedDevice | None = None,
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
        options = replace(self.options, stop_at=0)
        opened = device or choose_device(options.device, form=options.form)
        with self._folder.locked(), finished_or_stopped():
            loop.resume(read_scene_of(self._folder), options, opened, self._folder,
                        callbacks=callbacks)

    def evaluate(self, device: OpenedDevice | None = None) -> Score:
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
        if not self._folder.has_model:
            raise InputError(f"{self.path}: has no finished model yet; go on with it first, or "
                             "give Run.model to clsplat.evaluate")
        return score_of(evaluate_run(self._folder, device or best_device(), save_images=False))

    def __repr__(self) -> str:
        state = "finished" if self.is_finished else "not finished"
        return f"<clsplat.Run {str(self.path)!r}, {state}>"

    def _repr_html_(self) -> str:
        return run_page(self._folder)


@contextmanager
def finished_or_stopped() -> Iterator[None]:
    """A block whose training may end because a callback, or `stop_at`, has stopped it."""
    try:
        yield
    except Interrupted as error:
        if not error.planned:
            raise
