"""Poses of cameras and points from the matches of a database.

Global mapping (GLOMAP) places all photos at once, which is fast for many photos and does not fall
apart where few matches join two parts. It takes the longest tracks alone, some hundred a photo, as
poses gain nothing by more; then all tracks are triangulated and the bundle is adjusted once.
Incremental mapping follows where that does not register all photos that match others, or fits
badly, and the better of both is kept.
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
TRACKS_A_PHOTO = 300  # in global mapping; with all it takes three times as long
LARGEST_RESIDUAL, LEAST_ANGLE = 4.0, 1.5  # pixels, degrees; of points that stay, as in COLMAP
LEAST_PHOTOS = 3  # that show a point; two may agree by accident
MOST_STEPS, LEAST_GAIN = 20, 1e-5  # of the last adjustment
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
    if models:
        largest = max(models, key=lambda model: model.num_reg_images())
        models = [_triangulated(largest, database, work / "triangulation", fixed, progress)]
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
    options.mapper.track_required_tracks_per_view = TRACKS_A_PHOTO
    options.mapper.skip_retriangulation = True  # see `_triangulated`
    options.mapper.ba_num_iterations, options.mapper.ba_skip_fixed_rotation_stage = 2, True
    if fixed:
        options.mapper.bundle_adjustment.refine_focal_length = False
    else:
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = SEED
        _models(pycolmap.calibrate_view_graph, database, calibration)
    # without photos below the second path, COLMAP leaves points without colours
    return _models(pycolmap.global_mapping, database, _emptied(folder), folder, options)


def _triangulated(model: Any, database: Path, folder: Path, fixed: bool, progress: Progress) -> Any:
    """A reconstruction with the points of all tracks, adjusted to them."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors, options.ba_global_max_refinements = SEED, False, 1
    # whose tracks are merged and completed more willingly than in incremental mapping
    options.triangulation = pycolmap.GlobalMapperOptions().retriangulation
    options.triangulation.random_seed = SEED
    progress.phase("triangulation")
    # without photos below the third path, COLMAP leaves points without colours
    model = pycolmap.triangulate_points(model, database, _emptied(folder), folder, True, options)
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary, adjustment.refine_focal_length = False, not fixed
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    solver = adjustment.ceres.solver_options
    solver.max_num_iterations, solver.function_tolerance = MOST_STEPS, LEAST_GAIN
    progress.phase("bundle adjustment")
    pycolmap.bundle_adjustment(model, adjustment)
    observations = pycolmap.ObservationManager(model)
    observations.filter_all_points3D(LARGEST_RESIDUAL, LEAST_ANGLE)
    observations.filter_points3D_with_short_tracks(LEAST_PHOTOS)
    model.update_point_3d_errors()
    return model


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
