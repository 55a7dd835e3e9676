"""A run on disk, finished or not: the object by which all code reads runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.views import Model, opened
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.georeference.files import placed, read_georeference, read_orientation
from clsplat.io.models.formats import read_with_notes
from clsplat.io.models.tree import TREE, Tree
from clsplat.io.photos.undistort import undistorted
from clsplat.io.runs.run import RunFolder, read_exposures, read_poses
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import TrainOptions, recorded
from clsplat.rendering.slabs import ModelRenderer, open_model
from clsplat.rendering.tree import TreeRenderer
from clsplat.scene import Scene

if TYPE_CHECKING:
    from typing_extensions import Self


def shown(model: Gaussians, path: Path) -> Gaussians:
    """The model that was read from `path`; InputError if it is empty."""
    if not model.count:
        raise InputError(f"{path}: holds no gaussians, so there is nothing to show; give another model")
    return model


def to_render(path: Path, scene_path: Path | None) -> tuple[Gaussians, Scene, TrainOptions]:
    """The model, scene and options of `clsplat render`.

    Parameters
    ----------
    path : a run's folder, or a file of gaussians.
    scene_path : a scene whose cameras to use; None: the run's own.

    Returns
    -------
    The model in the frame of the scene, the scene at the size of the renders, with the poses that
    the run has corrected, and the options.

    Raises
    ------
    clsplat.ClsplatError : the run is not finished, or a file is given without a scene.
    """
    if path.is_dir():
        run = Run.open(path)
        options, model, scene = run.options, run.finished_model, scene_of_views(run, scene_path)
    elif scene_path is None:
        raise InputError(f"{path}: a file of gaussians has no cameras; name them with --scene SCENE")
    else:
        scene = read_scene(scene_path)
        model, notes = read_with_notes(path, scene.offset, scene.georeference)
        options = TrainOptions(max_resolution=0, antialiased=notes.antialiased)
    # of a run and another scene, the local origins differ
    model = shown(model, path).moved(scene.offset)
    return model, scene.reduced(options.downscale, options.max_resolution), options


def scene_of_views(run: Run, scene_path: Path | None) -> Scene:
    """The scene from whose cameras a run is rendered, at full size, with corrected poses: the run's
    own, or that of a path, which may be another one."""
    place, images = run.folder.scene_path(scene_path), run.options.images
    scene = read_scene(place, images if scene_path is None or (place / images).is_dir() else "")
    if run.record.get("fingerprint") == fingerprint(scene):
        scene = scene.corrected(read_poses(run.path))
    return scene


class Run:
    """A run folder, as `clsplat train` and `clsplat.train` write it; use `Run.open`.

    Attributes
    ----------
    path : its folder.
    folder : the object that reads and writes its files.
    """

    def __init__(self, folder: RunFolder) -> None:
        if not isinstance(folder, RunFolder):
            raise InputError(f"{folder}: a Run is made by clsplat.Run.open(path)")
        self.folder = folder
        self.path: Path = folder.path

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """The run in a folder.

        Parameters
        ----------
        path : the folder.

        Raises
        ------
        clsplat.ClsplatError : the folder does not hold a run.
        """
        return cls(RunFolder.open(path))

    @property
    def options(self) -> TrainOptions:
        """The options of the training, with all defaults resolved."""
        return recorded(self.record)

    @property
    def record(self) -> dict[str, Any]:
        """The content of options.json: the options, and facts such as the device."""
        return self.folder.read_options()

    @property
    def is_finished(self) -> bool:
        """Whether all steps are done and the report is written."""
        return self.folder.is_finished

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """The records of metrics.jsonl, each with `event`, `iteration` and `train_seconds`."""
        return self.folder.records()

    @property
    def finished_model(self) -> Gaussians:
        """Its gaussians after the last step; an error that says how to continue before that."""
        return self.folder.load_model()

    @property
    def exposures(self) -> dict[str, NDArray[np.float64]] | None:
        """Name of a training view -> float64[3, 4], its colour transform; None without any."""
        responses = read_exposures(self.path)
        if responses is None:
            return None
        return {name: response.transform for name, response in responses.items()}

    @property
    def georeference(self) -> Georeference | None:
        """Where its original coordinates lie on the earth; None: unknown."""
        return read_georeference(self.folder.path)

    @property
    def up(self) -> NDArray[np.float64]:
        """float64[3], the unit vector that points up."""
        known = read_orientation(self.folder.path)
        return self.scene().up if known is None else known[0]

    @property
    def first_view(self) -> Camera:
        """The camera, in original coordinates, from which a viewer should first look."""
        known = read_orientation(self.folder.path)
        if known is not None and known[1] is not None:
            return known[1]
        camera = self.scene().first_view
        return camera.shifted(-camera.offset)

    def scene(self, path: str | Path | None = None, *, whole: bool = False) -> Scene:
        """The scene of the training, as `clsplat.Run.scene` says.

        Parameters
        ----------
        path : where it is now; None: where the run has recorded it.
        whole : at the size of its photos, and with the poses that it brings.
        """
        place = self.folder.scene_path(None if path is None else Path(path))
        scene = placed(read_scene(place, self.options.images), self.folder.path)
        recorded = self.record.get("fingerprint")
        if recorded is not None and fingerprint(scene) != recorded:
            raise InputError(f"{place}: is not the scene that {self.path} was trained on; give that one with --scene")
        scene = undistorted(scene, self.folder.undistorted, make=False)
        return scene if whole else self.as_trained(scene)

    def as_trained(self, scene: Scene) -> Scene:
        """`scene(whole=True)` at the size of the training, with corrected poses."""
        options = self.options
        return scene.reduced(options.downscale, options.max_resolution).corrected(read_poses(self.path))

    def opened(self, device: Device, scene: Scene, model: Gaussians | None = None) -> Model:
        """A model on a device, to be rendered with the options of the run.

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
        clsplat.ClsplatError : the model is empty.
        """
        model = shown(model or self.finished_model, self.path)
        return opened(device, model, scene, self.options)

    def __repr__(self) -> str:
        state = "finished" if self.is_finished else "not finished"
        return f"<clsplat.Run {str(self.path)!r}, {state}>"


def has_tree(run: Run) -> bool:
    """Whether a run is a city that was merged into a tree, which is drawn in place of its model."""
    return (run.path / TREE).is_file()


def open_tree(run: Run, device: Device, near: float, host_bytes: float) -> tuple[TreeRenderer, Tree]:
    """What draws the tree of a run, and the tree; InputError if it is damaged.

    Parameters
    ----------
    run : the run.
    device : an open device.
    near : depth of the near plane, units of the model.
    host_bytes : see `TreeRenderer`.
    """
    tree, options = Tree(run.path / TREE), run.options
    return TreeRenderer(device, tree, near, options.antialiased, options.background, host_bytes=host_bytes), tree


def open_shown(
    run: Run, device: Device, near: float, host_bytes: float, model: Callable[[], Gaussians]
) -> tuple[ModelRenderer, Any, Tree | Gaussians]:
    """What draws a run in original coordinates: the renderer, its rows, and the tree, or without
    one the gaussians that `model` returns; other arguments as for `open_tree`."""
    if has_tree(run):
        renderer, tree = open_tree(run, device, near, host_bytes)
        return renderer, tree, tree
    gaussians, options = shown(model(), run.path), run.options
    return (*open_model(device, gaussians, near, options.antialiased, options.background), gaussians)
