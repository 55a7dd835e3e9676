"""Makes a scene from a folder of photos: the pipeline, step by step."""

import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pycolmap

from clsplat import __version__
from clsplat.errors import InputError
from clsplat.io.folders import make_folder
from clsplat.io.georeference.adjustment import NotGeoreferenced, check_marks
from clsplat.io.georeference.control_points import (
    ControlPoints,
    read_control_points,
    require_no_checks,
)
from clsplat.io.georeference.crs import scene_crs
from clsplat.io.georeference.files import write_georeference, write_orientation
from clsplat.io.georeference.reconstruction import Placed, place_reconstruction, turned
from clsplat.io.lock import HOLDER, LOCK, exclusive
from clsplat.io.photos.levels import common_levels, is_deep, levels_note
from clsplat.io.photos.mask_files import MASKS
from clsplat.io.reason import reason
from clsplat.io.records import object_of, plain, write_object
from clsplat.io.regular import read_regular
from clsplat.io.scenes.colmap_files import CAMERA_MODELS
from clsplat.sfm.database import create_database, photo_index
from clsplat.sfm.features import extract_features
from clsplat.sfm.mapping import Mapped, map_photos
from clsplat.sfm.matching import match_pairs
from clsplat.sfm.pairs import choose_pairs
from clsplat.sfm.photos import (
    RECORD,
    UNFINISHED,
    SourceCamera,
    SourcePhoto,
    are_calibrated,
    cameras_of,
    find_photos,
    is_video,
)
from clsplat.sfm.progress import Progress
from clsplat.sfm.record import reasons, record_of
from clsplat.sfm.scene import write_scene
from clsplat.sfm.unfinished import Unfinished
from clsplat.sfm.video import check_video, extract_frames

OWN_FILES = ("images", MASKS, "sparse", "georeference.json", "orientation.json")


@dataclass(frozen=True)
class SfmOptions:
    """Options of a reconstruction.

    Attributes
    ----------
    masks : a folder of masks, see `find_photos`, or None.
    matching : which pairs are matched, one of `pairs.METHODS`.
    camera_model : COLMAP's name of the camera model; "": by what is known of each camera.
    frames : of a video, how many are used.
    crs : coordinate reference system of the scene; "": the UTM zone.
    control_points : a file of ground control points, to which cameras and points are adjusted, or
        None.
    check_points : names of those that take no part and show the error.
    """

    masks: Path | None = None
    matching: str = "auto"
    camera_model: str = ""
    frames: int = 200
    crs: str = ""
    control_points: Path | None = None
    check_points: tuple[str, ...] = ()


@dataclass
class _Times:
    """Seconds that phases took."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def of(self, phase: str) -> Iterator[None]:
        """Measure the block."""
        start = time.monotonic()
        yield
        self.seconds[phase] = round(time.monotonic() - start, 1)


def reconstruct(source: Path, output: Path, options: SfmOptions, progress: Progress,
                overwrite: bool = False) -> dict[str, Any]:
    """Reconstruct a scene from photos or a video.

    Parameters
    ----------
    source : a folder of photos, or a video file.
    output : the folder of the new scene. What a killed reconstruction of the same source left there
        is used.
    overwrite : whether an existing scene that was made by this function is replaced.

    Returns
    -------
    What sfm.json holds.

    Raises
    ------
    InputError : the photos cannot be used, they match too little, the output exists, or the place
        that the options ask for cannot be found. The scene is then complete but for its place, and
        the same command with other control points goes on from there.
    """
    models = set(CAMERA_MODELS) - {"EQUIRECTANGULAR"}  # a pinhole camera cannot show a sphere
    if options.camera_model and options.camera_model not in models:
        raise InputError(f"--camera-model {options.camera_model}: is none of "
                         f"{', '.join(sorted(models))}; leave it out, or give one of them")
    crs = scene_crs(options.crs) if options.crs else None
    control = _control(options, crs)
    sources = source, options.masks
    _check_output(output, sources, overwrite)
    times = _Times()
    with times.of("photos"):
        found = _photos(source, options, progress)
    if found is not None:
        check_marks(control.points, {photo.name for photo in found[0]})
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(0)
    make_folder(output)
    with exclusive(output):
        _check_output(output, sources, overwrite)  # another process may have finished a scene
        _remove_scene(output, keeps=not overwrite)
        unfinished = Unfinished(output)
        make_folder(unfinished.folder)
        if found is None:
            with times.of("frames"):
                extract_frames(source, unfinished.frames, options.frames, progress)
            found = find_photos(unfinished.frames)
        photos, refused = found
        cameras = cameras_of(photos, options.camera_model)
        resumed = unfinished.open(photos, _kept(options), overwrite)
        mapped, matching = _mapped(unfinished, photos, refused, cameras, options, times, progress,
                                   is_video(source))
        model, placed, refused_place = _placed(mapped, unfinished, photos, cameras, control)
        with times.of("scene"):
            names = write_scene(output, model, photos, progress)
        write_orientation(output, placed.up)
        write_georeference(output, placed.georeference)
        missing = reasons(unfinished.database, photos, set(names), mapped.elsewhere, refused)
        record = {"version": __version__, "source": plain(source.resolve()),
                  "masks": _kept(options)["masks"], "matching": matching,
                  "levels": next((photo.levels for photo in photos if photo.levels), None),
                  **record_of(mapped, cameras, placed, missing), "seconds": times.seconds,
                  "resumed": resumed}
        write_object(output / RECORD, record)
        if refused_place and (options.control_points or options.crs):
            raise InputError(
                f"{output}: the scene is complete, but {placed.notes[0]}; correct this and give "
                "the command again, which goes on from here, or train the scene without a place")
        unfinished.remove()
    return record


def is_finished(output: Path, source: Path) -> bool:
    """Whether a folder holds the finished scene of these photos or this video; InputError if it is
    that of others, or photos were added or removed since."""
    path = output / RECORD
    if not path.exists():
        return False
    try:
        record = object_of(read_regular(path))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged ({reason(error)}); remove {output}") from None
    made_of, masks = record.get("source"), record.get("masks")
    if made_of != plain(source.resolve()):
        raise InputError(f"{output}: was made of {made_of}, not of {source}; remove it, or give "
                         "another -o")
    if not is_video(source):
        photos, refused = find_photos(source, Path(masks) if isinstance(masks, str) else None)
        count = len(photos) + len(refused)
        if record.get("photos") != count:
            raise InputError(f"{output}: was made of {record.get('photos')} photos of {source}, "
                             f"which now has {count}; remove it to make it again")
    return True


def _placed(mapped: Mapped, unfinished: Unfinished, photos: Sequence[SourcePhoto],
            cameras: Sequence[SourceCamera], control: ControlPoints
            ) -> tuple[pycolmap.Reconstruction, Placed, bool]:
    """The reconstruction in its place, what was found, and whether it has no place."""
    def named(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        for image in model.images.values():
            image.name = photos[photo_index(image.image_id)].name
        return model

    metadata = {photo.name: photo.metadata for photo in photos}
    model = named(mapped.reconstruction)
    try:
        placed = place_reconstruction(
            model, metadata, crs=control.crs or None, control=control.points,
            vertical=control.vertical, adjusts=True, keep_focal=are_calibrated(cameras))
    except NotGeoreferenced as error:
        model = named(unfinished.kept().reconstruction)  # as it was before an adjustment
        return model, turned(model, metadata, error), True
    return model, replace(placed, notes=(*control.notes, *placed.notes)), False


def _control(options: SfmOptions, crs: str | None) -> ControlPoints:
    """The ground control points, and the CRS of the scene, "" if it is not given."""
    if options.control_points is None:
        require_no_checks(options.check_points)
        return ControlPoints(crs=crs or "")
    return read_control_points(options.control_points, crs, options.check_points)


def _check_output(output: Path, sources: Iterable[Path | None], overwrite: bool) -> None:
    """InputError if the folder of a scene holds something that may not be replaced.

    Parameters
    ----------
    sources : folders and files from which the scene is made.
    """
    if (output / RECORD).exists():
        if not overwrite and not Unfinished.is_in(output):
            raise InputError(f"{output}: holds a reconstructed scene already; give another folder, "
                             "or --overwrite")
    elif output.exists() and not Unfinished.is_in(output) and (
            not output.is_dir() or {path.name for path in output.iterdir()} - {LOCK, HOLDER}):
        raise InputError(f"{output}: exists and was not made by `clsplat sfm`; give another folder")
    for path in filter(None, sources):
        if path.resolve().is_relative_to(output.resolve()):
            raise InputError(f"{path}: is in {output}, whose files are replaced; give another "
                             "folder for the scene")


def _remove_scene(output: Path, keeps: bool) -> None:
    """Remove a finished scene that is to be replaced, its record first.

    Parameters
    ----------
    keeps : whether only the record is removed, of a scene that lacks its place.
    """
    if (output / RECORD).exists():
        (output / RECORD).unlink()
        if keeps:
            return
        for name in (*OWN_FILES, UNFINISHED):  # the last, where a command was killed at its end
            path = output / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def _kept(options: SfmOptions) -> dict[str, Any]:
    """The options on which features, matches and poses depend."""
    return {"masks": options.masks and str(options.masks.resolve()), "matching": options.matching,
            "camera_model": options.camera_model}


def _photos(source: Path, options: SfmOptions, progress: Progress
            ) -> tuple[list[SourcePhoto], dict[str, str]] | None:
    """`find_photos` of a folder; None for a video."""
    if is_video(source):
        if options.masks is not None:
            raise InputError("--masks: cannot be used with a video; leave it out")
        check_video(source)
        return None
    progress.phase("reading metadata of photos")
    photos, refused = find_photos(source, options.masks)
    masked = sum(photo.mask is not None for photo in photos)
    if masked:
        progress.message(f"{masked} of {len(photos)} photos have a mask: dark pixels are not used")
    paths = [photo.path for photo in photos]
    levels = common_levels(paths, map(is_deep, paths))
    note = levels_note(levels)
    if note:
        progress.message(note)
    return [replace(photo, levels=each) for photo, each in zip(photos, levels)], refused


def _mapped(unfinished: Unfinished, photos: Sequence[SourcePhoto], refused: dict[str, str],
            cameras: Sequence[SourceCamera], options: SfmOptions, times: _Times,
            progress: Progress, is_sequence: bool) -> tuple[Mapped, str]:
    """The reconstruction, and which pairs were matched; `refused` gets damaged photos."""
    database = unfinished.database
    try:
        if not database.exists():
            create_database(database, cameras)
        with times.of("features"):
            refused.update(extract_features(database, photos, progress))
        with times.of("pairs"):
            pairs = choose_pairs(database, photos, options.matching, is_sequence, progress)
        progress.message(f"matching {pairs.reason}")
        with times.of("matching"):
            match_pairs(database, pairs, progress)
    except RuntimeError as error:  # of SQLite in pycolmap, which gives no other reason
        raise InputError(f"{database}: cannot be written or read ({reason(error)}); check that the "
                         "disk has space, and give the command again") from error
    with times.of("mapping"):
        mapped = unfinished.mapped(lambda: map_photos(database, cameras, len(photos), progress))
    return mapped, pairs.reason
