"""`clsplat.Run`: a run that is continued, evaluated and shown in notebooks."""

from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from pathlib import Path

from clsplat import scene as core
from clsplat.api.gaussians import Gaussians
from clsplat.api.scene import Scene
from clsplat.api.score import Score
from clsplat.device import Device, choose_device
from clsplat.errors import InputError, Interrupted
from clsplat.evaluation import run
from clsplat.evaluation.views import evaluate_run, final_metrics
from clsplat.report.notebook import run_page
from clsplat.training.checkpoint import latest_model
from clsplat.training.part import Part
from clsplat.training.recorder import Callback
from clsplat.training.run import resumed


class Run(run.Run):
    __doc__ = run.Run.__doc__

    @property
    def model(self) -> Gaussians:
        """Its gaussians: the finished model, or else those of the last checkpoint."""
        return Gaussians.of(latest_model(self.folder))

    def scene(self, path: str | Path | None = None, *, whole: bool = False) -> Scene:
        """The scene of the training, at the size of the training.

        Parameters
        ----------
        path : where the scene is now; None: where the run has recorded it.
        whole : at the size of its photos instead, and with the poses that it brings; otherwise
            training views have the poses that the run has corrected.

        Raises
        ------
        clsplat.ClsplatError : the scene is missing, or is another one.
        """
        return Scene.of(super().scene(path, whole=whole))

    def resume(
        self,
        *,
        device: Device | None = None,
        scene: core.Scene | None = None,
        parts: Iterable[Part] = (),
        callbacks: Iterable[Callback] = (),
    ) -> None:
        """Continue a training that was stopped, from its last checkpoint to its end.

        Parameters
        ----------
        device : an open device; None: that of the run's option.
        scene : as it was given to the training; None: it is read where the run has recorded it.
        parts : those that were given to the training.
        callbacks : as for `clsplat.train`.

        Raises
        ------
        clsplat.ClsplatError : its scene is missing or its checkpoint is damaged.
        """
        options = replace(self.options, stop_at=0)
        device = device or choose_device(options.device, form=options.form)
        scene = scene or super().scene(whole=True)
        with self.folder.locked():
            try:
                resumed(scene, options, device, self.folder, callbacks=callbacks, parts=parts).take()
            except Interrupted as error:
                if not error.planned:
                    raise

    def evaluate(
        self, device: Device | None = None, *, lpips: str | PathLike[str] | None = None, align: bool = False
    ) -> Score:
        """Compare the finished model with the held-out photos.

        Parameters
        ----------
        device : an open device; None: the best that works.
        lpips : an ONNX file with an LPIPS network, whose score is wanted too.
        align : whether the held-out photos are also compared from poses that are aligned with them
            (`clsplat eval --align`).

        Returns
        -------
        The Score.

        Raises
        ------
        clsplat.ClsplatError : the run has no model or holds out no view.
        """
        if not self.folder.has_model:
            raise InputError(
                f"{self.path}: has no finished model yet; resume it first, or give Run.model to clsplat.evaluate"
            )
        return Score.of(
            evaluate_run(
                self, device or choose_device("auto"), save_images=False, metrics=final_metrics(lpips), align=align
            )
        )

    def _repr_html_(self) -> str:
        return run_page(self)
