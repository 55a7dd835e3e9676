"""Smaller finished models: without invisible and unsupported gaussians, and unneeded spherical
harmonics."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.apps.orthophoto import LEAST_VIEWS, shown_by
from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.edit.transform import transformed
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import evaluate_views
from clsplat.gaussians import Gaussians
from clsplat.io.models.formats import write_model
from clsplat.io.models.values import mode_comment
from clsplat.scene import Scene

log = logging.getLogger(__name__)
VIEWERS_UP = np.array([0.0, -1.0, 0.0])  # of SuperSplat and others, in the axes of a PLY


def supported(gaussians: Gaussians, photos: Sequence[Camera]) -> NDArray[np.bool_]:
    """[N]: whether at least LEAST_VIEWS photos show the place of a gaussian, hidden there or not,
    as on a map; all, with a warning, if that holds for none.

    Parameters
    ----------
    gaussians : the model.
    photos : cameras, in original coordinates up to their offsets.
    """
    shifted = [camera.shifted(gaussians.offset - camera.offset) for camera in photos]
    shown = shown_by(shifted, gaussians.positions.astype(np.float64)) >= LEAST_VIEWS
    if shown.any() or not gaussians.count:
        return shown
    if shifted:
        log.warning("no two photos show any of the %s gaussians, so all are kept",
                    f"{gaussians.count:,}")
    return np.ones(gaussians.count, bool)


def photos_of(run: Run, scene_path: Path | None = None) -> list[Camera]:
    """The cameras of a run's photos in original coordinates; empty if its scene is not there.

    Parameters
    ----------
    run : the run.
    scene_path : where the scene is now, which must then be there; None: where the run has recorded
        it.
    """
    try:
        scene = run.scene(scene_path)
    except InputError:
        if scene_path is not None:
            raise
        return []
    return in_original(scene)


def in_original(scene: Scene) -> list[Camera]:
    """The cameras of a scene in original coordinates."""
    return [replace(view.camera, translation=scene.unit * view.camera.translation,
                    offset=scene.offset).shifted(-scene.offset) for view in scene.views]


def needed_sh_degree(run: Run, device: Device, cost: float, scene_path: Path | None = None
                     ) -> tuple[int, list[float]]:
    """The lowest degree of the spherical harmonics (SH) that the held-out views of a run need.

    Parameters
    ----------
    run : a finished run.
    device : an open device.
    cost : dB, the loss of PSNR, mean over views, that is allowed.
    scene_path : where the scene is now; None: where the run has recorded it.

    Returns
    -------
    The degree, and the PSNR at degree 0, 1, ..., dB.

    Raises
    ------
    InputError : the run does not hold out a view.
    """
    options, scene = run.options, run.scene(scene_path)
    _, views = scene.split(options.test_every, options.test_offset)
    if not views:
        raise InputError(f"{run.path}: no held-out views to measure on (--test-every "
                         f"{options.test_every}); name a degree instead of auto")
    renderer, rows, highest = run.opened(device, scene)
    scores = [evaluate_views(renderer, rows, degree, views)["psnr"]
              for degree in range(highest + 1)]
    enough = [degree for degree, score in enumerate(scores) if scores[-1] - score < cost]
    return min(enough, default=highest), scores


def write_run_model(path: Path, run: Run, gaussians: Gaussians, upright: bool = False) -> None:
    """Write gaussians of a run in the format of a suffix, with what the run knows about them.

    Parameters
    ----------
    path : as for `models.write_model`.
    gaussians : in original coordinates.
    upright : turn them so that up is -y.

    Raises
    ------
    InputError : it is not known what is up, or the file cannot be written.
    """
    comments = (mode_comment(run.options.antialiased),)
    if upright:
        turn, _ = Rotation.align_vectors([VIEWERS_UP], [run.up])
        turned = transformed(gaussians, rotation=turn.as_matrix())
        write_model(path, turned, comments, VIEWERS_UP)
        return
    write_model(path, gaussians, comments, run.known_up, run.georeference)
