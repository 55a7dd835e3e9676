"""Poses of cameras and points from the matches of a database.

Global mapping (GLOMAP) places all photos at once, which is fast for many photos and does not fall
apart where few matches join two parts. Incremental mapping follows where that does not register
all photos that match others, or fits badly, and the better of both is kept.
"""

import itertools
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from clsplat.errors import InputError
from clsplat.sfm.features import camera_of, partners
from clsplat.sfm.photos import SourceCamera, are_calibrated
from clsplat.sfm.progress import Progress

LARGEST_ASPECT = 0.02  # by which the two focal lengths of a camera may differ
LARGEST_ERROR = 1.5  # pixels, the mean reprojection error above which a result fits badly
SEED = 0


def map_photos(database: Path, cameras: Sequence[SourceCamera], photos: int, progress: Progress
               ) -> Any:
    """A pycolmap.Reconstruction of so many photos, InputError if none could be placed.

    Parameters
    ----------
    database : with the matches of the photos; its folder keeps intermediate results.
    cameras : of the photos; see `are_calibrated`.
    photos : how many there are.
    """
    fixed, matched = are_calibrated(cameras), len(partners(database))
    work = database.parent
    progress.phase("global mapping")
    models = _global(database, work / "global", fixed)
    if not fixed and not all(map(_square, models)):
        _use_square_pixels(database, cameras)
        models = _global(database, work / "global", fixed)
    # photos that match no other one cannot be placed in any way
    if matched and not any(model.num_reg_images() == matched
                           and model.compute_mean_reprojection_error() <= LARGEST_ERROR
                           for model in models):
        registered = itertools.count(3)  # the first call follows the first pair and one more

        def show() -> None:  # more often than there are photos if a second attempt follows
            progress.count("incremental mapping, photo", min(next(registered), photos), photos)

        progress.phase("incremental mapping")
        models += _incremental(database, work / "incremental", fixed, show)
    if not models:
        raise InputError(f"{work.parent}: no photos could be placed, since too few of their "
                         "features match; photos must be sharp, overlap by more than half, and be "
                         "taken from different places")
    return max(models, key=lambda model: (model.num_reg_images(), model.compute_num_observations()))


def _square(model: Any) -> bool:
    """Whether the focal lengths of each camera are nearly equal, as those of all lenses are; else
    the photos do not determine so many parameters."""
    return all(abs(camera.focal_length_x / camera.focal_length_y - 1) <= LARGEST_ASPECT
               for camera in model.cameras.values())


def _use_square_pixels(path: Path, cameras: Sequence[SourceCamera]) -> None:
    """Give cameras that may have two focal lengths and decentring a model that has neither."""
    with pycolmap.Database.open(path) as database:
        for number, source in enumerate(cameras, 1):
            if source.model == "OPENCV" and source.calibration is None:
                database.update_camera(camera_of(number, replace(source, model="RADIAL")))


def _global(database: Path, folder: Path, fixed: bool) -> list[Any]:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = SEED
    if fixed:
        options.mapper.bundle_adjustment.refine_focal_length = False
    else:
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = SEED
        _models(pycolmap.calibrate_view_graph, database, calibration)
    # without photos below the second path, COLMAP leaves points without colours
    return _models(pycolmap.global_mapping, database, _emptied(folder), folder, options)


def _incremental(database: Path, folder: Path, fixed: bool, registered: Callable[[], None]
                 ) -> list[Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors = SEED, False
    if fixed:
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    return _models(pycolmap.incremental_mapping, database, _emptied(folder), folder, options,
                   next_image_callback=registered)


def _models(function: Any, *arguments: Any, **named: Any) -> list[Any]:
    """What a function of pycolmap finds; [] if it fails, as where hardly anything matches."""
    try:
        found = function(*arguments, **named)
    except (RuntimeError, ValueError):
        return []
    return list(found.values()) if isinstance(found, dict) else []


def _emptied(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder
