"""Poses of cameras and points from the matches of a database.

Global mapping (GLOMAP) places all photos at once, which is fast for many photos and does not fall
apart where few matches join two parts. Incremental mapping follows where that does not register
all photos that match others, or fits badly, and the better of both is kept.
"""

import itertools
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from clsplat.errors import InputError
from clsplat.sfm.database import camera_of, partners, photo_index
from clsplat.sfm.photos import SourceCamera, are_calibrated
from clsplat.sfm.progress import Progress

LARGEST_ASPECT = 0.02  # by which the two focal lengths of a camera may differ
LARGEST_ERROR = 1.5  # pixels, the mean reprojection error above which a result fits badly
SEED = 0


@dataclass(frozen=True, eq=False)
class Mapped:
    """What mapping found.

    Attributes
    ----------
    reconstruction : a pycolmap.Reconstruction, the best one.
    method : "global" or "incremental".
    elsewhere : indices of photos that were placed in another part of the scene only.
    """

    reconstruction: Any
    method: str
    elsewhere: tuple[int, ...] = ()


def map_photos(database: Path, cameras: Sequence[SourceCamera], photos: int, progress: Progress
               ) -> Mapped:
    """Reconstruct the poses of photos.

    Parameters
    ----------
    database : with the matches of the photos; its folder keeps intermediate results.
    cameras : of the photos; see `are_calibrated`.
    photos : how many there are.

    Raises
    ------
    InputError : no photos could be placed.
    """
    fixed, matched = are_calibrated(cameras), len(partners(database))
    work = database.parent
    progress.phase("global mapping")
    found = {"global": _global(database, work / "global", fixed)}
    if not fixed and not all(map(square, found["global"])):
        use_square_pixels(database, cameras)
        found = {"global": _global(database, work / "global", fixed)}
    # photos that match no other one cannot be placed in any way
    if matched and not good(found["global"], matched):
        registered = itertools.count(3)  # the first call follows the first pair and one more

        def show() -> None:
            number = next(registered)  # more than all if a second attempt follows
            if number < photos:
                progress.count("incremental mapping, photo", number, photos)
            else:
                progress.phase("incremental mapping, last adjustments")

        progress.phase("incremental mapping")
        found["incremental"] = _incremental(database, work / "incremental", fixed, show)
    method, models = max(found.items(), key=lambda item: max(map(quality, item[1]), default=(0, 0)))
    if not models:
        raise InputError(f"{work.parent}: no photos could be placed, since too few of their "
                         "features match; photos must be sharp, overlap by more than half, and be "
                         "taken from different places")
    best = max(models, key=quality)
    own = set(best.reg_image_ids())
    others = {number for model in models for number in model.reg_image_ids()} - own
    return Mapped(best, method, tuple(sorted(map(photo_index, others))))


def good(models: Iterable[Any], photos: int) -> bool:
    """Whether one of the reconstructions has all photos and fits their features."""
    return any(model.num_reg_images() == photos
               and model.compute_mean_reprojection_error() <= LARGEST_ERROR for model in models)


def square(model: Any) -> bool:
    """Whether the focal lengths of each camera are nearly equal, as those of all lenses are; else
    the photos do not determine so many parameters."""
    return all(abs(camera.focal_length_x / camera.focal_length_y - 1) <= LARGEST_ASPECT
               for camera in model.cameras.values())


def use_square_pixels(database: Path, cameras: Sequence[SourceCamera]) -> None:
    """Give cameras that may have two focal lengths and decentring a model that has neither."""
    opened = pycolmap.Database.open(database)
    try:
        for number, source in enumerate(cameras, 1):
            if source.model == "OPENCV" and source.calibration is None:
                opened.update_camera(camera_of(number, replace(source, model="RADIAL")))
    finally:
        opened.close()


def quality(model: Any) -> tuple[int, int]:
    """What is larger for a better reconstruction: its photos, then its observations."""
    return model.num_reg_images(), model.compute_num_observations()


def _global(database: Path, folder: Path, fixed: bool) -> list[Any]:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = SEED
    if fixed:
        options.mapper.bundle_adjustment.refine_focal_length = False
    else:
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = SEED
        _run(pycolmap.calibrate_view_graph, database, calibration)
    # without photos below the second path, COLMAP leaves points without colours
    return _models(_run(pycolmap.global_mapping, database, _emptied(folder), folder, options))


def _incremental(database: Path, folder: Path, fixed: bool, registered: Any) -> list[Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors = SEED, False
    if fixed:
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    return _models(_run(pycolmap.incremental_mapping, database, _emptied(folder), folder, options,
                        next_image_callback=registered))


def _models(found: Any) -> list[Any]:
    return [] if found is None else list(found.values())


def _run(function: Any, *arguments: Any, **named: Any) -> Any:
    """Call a function of pycolmap; None if it fails, as it does where hardly anything matches."""
    try:
        return function(*arguments, **named)
    except (RuntimeError, ValueError):
        return None


def _emptied(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder
