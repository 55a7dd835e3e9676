"""Models of runs for other programs: without unsupported gaussians, as they are or upright."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.apps.orthophoto import LEAST_VIEWS, shown_by
from clsplat.camera import Camera
from clsplat.edit.transform import transformed
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.io.models.formats import write_model
from clsplat.io.models.values import mode_comment
from clsplat.scene import Scene

log = logging.getLogger(__name__)
VIEWERS_UP = np.array([0.0, -1.0, 0.0])  # of SuperSplat and others, in the axes of a PLY


def support(gaussians: Gaussians, photos: Sequence[Camera]) -> NDArray[np.int64]:
    """int64[N]: how many photos show the place of each gaussian, hidden there or not, as on a map.
    The photos' cameras are in original coordinates up to their offsets."""
    shifted = [camera.shifted(gaussians.offset - camera.offset) for camera in photos]
    return shown_by(shifted, gaussians.positions.astype(np.float64))


def supported(gaussians: Gaussians, photos: Sequence[Camera]) -> NDArray[np.bool_]:
    """bool[N]: whether at least LEAST_VIEWS photos show the place of a gaussian, see `support`;
    all, with a warning, if that holds for none."""
    shown = support(gaussians, photos) >= LEAST_VIEWS
    if not shown.any():
        log.warning("no two photos show any of the %s gaussians, so all are kept", f"{gaussians.count:,}")
        shown[:] = True
    return shown


def scene_of(run: Run, scene_path: Path | None = None) -> Scene | None:
    """The scene of a run; None if it is not where it was recorded, but one that `scene_path` names
    must be there."""
    try:
        return run.scene(scene_path)
    except InputError:
        if scene_path is not None:
            raise
        return None


def photos_of(run: Run, scene_path: Path | None = None) -> list[Camera]:
    """The cameras of the scene of a run, see `scene_of`, in original coordinates; empty without
    it."""
    scene = scene_of(run, scene_path)
    return in_original(scene) if scene else []


def in_original(scene: Scene) -> list[Camera]:
    """The cameras of a scene in original coordinates."""
    return [
        replace(view.camera, translation=scene.unit * view.camera.translation, offset=scene.offset).shifted(
            -scene.offset
        )
        for view in scene.views
    ]


def turned_up(gaussians: Gaussians, up: NDArray[np.float64], to: NDArray[np.float64]) -> Gaussians:
    """A model after the smallest rotation that turns its `up`, a unit vector, to another one."""
    if np.allclose(up, to, atol=1e-9):
        return gaussians.without_spheres()
    turn, _ = scipy.spatial.transform.Rotation.align_vectors([to], [up])
    return transformed(gaussians, rotation=turn.as_matrix())


def write_run_model(path: Path, run: Run, gaussians: Gaussians, upright: bool = False, spz_version: int = 0) -> None:
    """Write gaussians of a run, in original coordinates, in the format of a suffix, with what is
    known about them; `upright` turns them so that up is -y; `spz_version` as for `write_model`.

    Raises
    ------
    InputError : it is not known what is up, or the file cannot be written.
    """
    comments = (mode_comment(run.options.antialiased),)
    if upright:
        write_model(path, turned_up(gaussians, run.up, VIEWERS_UP), comments, VIEWERS_UP, spz_version=spz_version)
    else:
        write_model(path, gaussians, comments, run.up, run.georeference, spz_version)
