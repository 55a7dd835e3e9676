"""Poses of cameras and points from the matches of a database.

Global mapping (GLOMAP) places all photos at once, which is fast for many photos and does not fall
apart where few matches join two parts. It takes the longest tracks alone, some hundred a photo, as
poses gain nothing by more; then all tracks are triangulated and the bundle is adjusted once.
Incremental mapping follows where that does not register all photos that match others, or fits
badly, and the better of both is kept.
"""

import copy
import itertools
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from clsplat.errors import InputError
from clsplat.io.scenes.colmap import write_reconstruction
from clsplat.sfm.features import camera_of, partners
from clsplat.sfm.photos import SourceCamera, are_calibrated
from clsplat.sfm.progress import Progress

LARGEST_ASPECT = 0.02  # by which the two focal lengths of a camera may differ
LARGEST_ERROR = 1.5  # pixels, the mean reprojection error above which a result fits badly
FEW_PHOTOS, ATTEMPTS = 60, 3  # at most; from random positions, chains of photos may come apart
TRACKS_A_PHOTO = 300  # in global mapping; with all it takes three times as long
LARGEST_RESIDUAL, LEAST_ANGLE = 4.0, 1.5  # pixels, degrees; of points that stay, as in COLMAP
LEAST_PHOTOS = 3  # that show a point; two may agree by accident
LARGEST_LOSS = 0.01  # of the error, by which cameras without distortion may fit worse
MOST_STEPS, LEAST_GAIN = 20, 1e-5  # of an adjustment of all
SEED = 0


def map_photos(database: Path, cameras: Sequence[SourceCamera], photos: int, progress: Progress) -> Any:
    """A pycolmap.Reconstruction of so many photos, InputError if none could be placed.

    Parameters
    ----------
    database : with the matches of the photos; its folder keeps intermediate results, from which a
        killed command goes on.
    cameras : of the photos; see `are_calibrated`.
    photos : how many there are.
    """
    fixed, matched = are_calibrated(cameras), len(partners(database))
    work, models = database.parent, []
    placed = _kept(work / "global", lambda: _placed(database, cameras, fixed, progress))
    if placed is not None:
        progress.phase("triangulation")
        models.append(_kept(work / "triangulated", lambda: _triangulated(placed, database, work / "triangulation")))
        progress.phase("bundle adjustment")
        _adjust(models[0], fixed)
    # photos that match no other one cannot be placed in any way
    if matched and not any(
        model.num_reg_images() == matched and model.compute_mean_reprojection_error() <= LARGEST_ERROR
        for model in models
    ):
        registered = itertools.count(3)  # the first call follows the first pair and one more

        def show() -> None:  # more often than there are photos if a second attempt follows
            progress.count("incremental mapping, photo", min(next(registered), photos), photos)

        progress.phase("incremental mapping")
        models += _incremental(database, work / "incremental", fixed, show)
    if not models:
        raise InputError(
            f"{work.parent}: no photos could be placed, since too few of their "
            "features match; photos must be sharp, overlap by more than half, and be "
            "taken from different places"
        )
    return max(models, key=lambda model: (model.num_reg_images(), model.compute_num_observations()))


def keep_model(folder: Path, model: Any) -> None:
    """Write a pycolmap.Reconstruction into a folder, which appears whole or not at all."""
    partial = _emptied(folder.with_suffix(".part"))
    write_reconstruction(partial, model)
    partial.rename(folder)


def _kept(folder: Path, make: Callable[[], Any]) -> Any:
    """The reconstruction of a folder that a killed command has left, or else a new one, which may
    be None."""
    if folder.is_dir():
        return pycolmap.Reconstruction(folder)
    model = make()
    if model is not None:
        keep_model(folder, model)
    return model


def _placed(database: Path, cameras: Sequence[SourceCamera], fixed: bool, progress: Progress) -> Any:
    """The best reconstruction of global mapping, or None."""
    attempts = ATTEMPTS if sum(len(source.photos) for source in cameras) <= FEW_PHOTOS else 1
    models = _global(database, fixed, attempts, progress)
    if not fixed and not all(map(_square, models)):
        _use_square_pixels(database, cameras)
        models = _global(database, fixed, attempts, progress)
    if not models:
        return None
    best = max(models, key=lambda model: (model.num_reg_images(), -model.compute_mean_reprojection_error()))
    keeps = fixed or any(source.is_chosen for source in cameras)
    return best if keeps else _without_distortion(best, database, progress)


def _without_distortion(model: Any, database: Path, progress: Progress) -> Any:
    """A reconstruction, whose cameras become pinhole cameras, there and in the database, if these
    fit hardly worse: photos that a program has undistorted are then not interpolated again, and
    poses are nearer to the truth."""
    progress.phase("global mapping, without lens distortion")
    straight = copy.deepcopy(model)
    for camera in straight.cameras.values():
        has_two = len(camera.focal_length_idxs()) == 2
        kept = [*camera.focal_length_idxs(), *camera.principal_point_idxs()]
        values = camera.params[kept]
        camera.model = pycolmap.CameraModelId.PINHOLE if has_two else pycolmap.CameraModelId.SIMPLE_PINHOLE
        camera.params = values
    _adjust(straight, False)
    errors = [each.compute_mean_reprojection_error() for each in (model, straight)]
    if errors[1] > (1 + LARGEST_LOSS) * errors[0]:
        return model
    with pycolmap.Database.open(database) as opened:
        for camera in straight.cameras.values():
            opened.update_camera(camera)
    return straight


def _square(model: Any) -> bool:
    """Whether the focal lengths of each camera are nearly equal, as those of all lenses are; else
    the photos do not determine so many parameters."""
    return all(
        abs(camera.focal_length_x / camera.focal_length_y - 1) <= LARGEST_ASPECT for camera in model.cameras.values()
    )


def _use_square_pixels(path: Path, cameras: Sequence[SourceCamera]) -> None:
    """Give cameras that may have two focal lengths and decentring a model that has neither."""
    with pycolmap.Database.open(path) as database:
        for number, source in enumerate(cameras, 1):
            if source.model == "OPENCV" and source.calibration is None:
                database.update_camera(camera_of(number, replace(source, model="RADIAL")))


def _global(database: Path, fixed: bool, attempts: int, progress: Progress) -> list[Any]:
    """The reconstructions of so many attempts."""
    options = pycolmap.GlobalPipelineOptions()
    options.mapper.track_required_tracks_per_view = TRACKS_A_PHOTO
    options.mapper.skip_retriangulation = True  # see `_triangulated`
    options.mapper.ba_num_iterations, options.mapper.ba_skip_fixed_rotation_stage = 2, True
    progress.phase("global mapping")
    if fixed:
        options.mapper.bundle_adjustment.refine_focal_length = False
    models, adjustments = [], itertools.count(1)

    def show() -> None:
        progress.phase(f"global mapping, adjustment {next(adjustments)}")

    for attempt in range(attempts):
        seed = options.random_seed = options.mapper.random_seed = SEED + attempt
        tried = database
        if attempts > 1:  # the relative poses of an attempt, which it writes there, are its own
            tried = Path(shutil.copyfile(database, database.with_name("attempt.db")))
        if not fixed:
            calibration = pycolmap.ViewGraphCalibrationOptions()
            calibration.random_seed = seed
            _models(pycolmap.calibrate_view_graph, tried, calibration)
        found = pycolmap.ReconstructionManager()
        with pycolmap.Database.open(tried) as opened:
            pipeline = pycolmap.GlobalPipeline(options, opened, found)
            pipeline.add_callback(pycolmap.GlobalPipelineCallback.MODEL_UPDATE_CALLBACK.value, show)
            with suppress(RuntimeError, ValueError):  # as where hardly anything matches
                pipeline.run()
        models += [found.get(number) for number in range(found.size())]
    return models


def _triangulated(model: Any, database: Path, folder: Path) -> Any:
    """A reconstruction with the points of all tracks."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors = SEED, False
    options.ba_global_max_refinements = 1
    # whose tracks are merged and completed more willingly than in incremental mapping
    options.triangulation = pycolmap.GlobalMapperOptions().retriangulation
    options.triangulation.random_seed = SEED
    # without photos below the third path, COLMAP leaves points without colours
    return pycolmap.triangulate_points(model, database, _emptied(folder), folder, True, options)


def _adjust(model: Any, fixed: bool) -> None:
    """Adjust cameras, poses and points of a reconstruction to its observations, and remove what
    fits badly."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_focal_length = False, not fixed
    options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    solver = options.ceres.solver_options
    solver.max_num_iterations, solver.function_tolerance = MOST_STEPS, LEAST_GAIN
    # pycolmap.bundle_adjustment does the same, but prints lines that cannot be turned off
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    observations = pycolmap.ObservationManager(model)
    observations.filter_all_points3D(LARGEST_RESIDUAL, LEAST_ANGLE)
    observations.filter_points3D_with_short_tracks(LEAST_PHOTOS)
    model.update_point_3d_errors()


def _incremental(database: Path, folder: Path, fixed: bool, registered: Callable[[], None]) -> list[Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors = SEED, False
    if fixed:
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    return _models(
        pycolmap.incremental_mapping, database, _emptied(folder), folder, options, next_image_callback=registered
    )


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
