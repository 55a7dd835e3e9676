"""Makes a scene from a folder of photos: the pipeline, step by step.

What is unfinished lies in the folder .sfm of the scene, so that a killed command continues.
"""

import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from clsplat import __version__
from clsplat.errors import InputError
from clsplat.io.folders import make_folder
from clsplat.io.georeference.adjustment import NotGeoreferenced, check_marks
from clsplat.io.georeference.control_points import ControlPoints, read_control_points
from clsplat.io.georeference.crs import scene_crs
from clsplat.io.georeference.files import write_georeference, write_orientation
from clsplat.io.georeference.reconstruction import Placed, place_reconstruction, turned
from clsplat.io.lock import HOLDER, LOCK, exclusive
from clsplat.io.photos.masks import MASKS
from clsplat.io.photos.photo import common_levels, levels_note
from clsplat.io.reason import reason
from clsplat.io.records import object_of, plain, write_object
from clsplat.io.regular import read_regular
from clsplat.io.scenes.colmap import write_reconstruction
from clsplat.io.scenes.colmap_files import CAMERA_MODELS
from clsplat.io.scenes.sources import IMAGES
from clsplat.sfm.database import create_database
from clsplat.sfm.features import extract_features, match_pairs
from clsplat.sfm.mapping import Mapped, map_photos
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
from clsplat.sfm.scene import reasons, record_of, write_scene
from clsplat.sfm.video import DONE as FRAMES_DONE
from clsplat.sfm.video import check_video, extract_frames

WRITTEN = (IMAGES, MASKS, "sparse", "georeference.json", "orientation.json")
STATE, MODEL, MAPPED = "state.json", "model", "mapped.json"  # in the folder .sfm


@dataclass(frozen=True)
class SfmOptions:
    """Options of a reconstruction.

    Attributes
    ----------
    masks : a folder of masks, see `find_photos`, or None.
    matching : which pairs are matched, as for `pairs.choose_pairs`.
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
    control = _control(options)
    sources = source, options.masks
    _check_output(output, sources, overwrite)
    seconds: dict[str, float] = {}

    @contextmanager
    def timed(phase: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        seconds[phase] = round(time.monotonic() - start, 1)

    with timed("photos"):
        found = _photos(source, options, progress)
    if found is not None:
        check_marks(control.points, {photo.name for photo in found[0]})
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(0)
    make_folder(output)
    with exclusive(output):
        _check_output(output, sources, overwrite)  # another process may have finished a scene
        unfinished = Unfinished(output)
        if overwrite and (output / RECORD).exists():
            unfinished.forget()
        (output / RECORD).unlink(missing_ok=True)
        if found is None:
            with timed("frames"):
                extract_frames(source, unfinished.frames, options.frames, progress)
            found = find_photos(unfinished.frames)
        photos, refused = found
        cameras = cameras_of(photos, options.camera_model)
        kept = {"masks": options.masks and str(options.masks.resolve()),
                "matching": options.matching, "camera_model": options.camera_model}
        resumed = unfinished.open(photos, kept, overwrite)
        database = unfinished.folder / "database.db"
        try:
            if not database.exists():
                create_database(database, cameras)
            with timed("features"):
                refused |= extract_features(database, photos, progress)
            with timed("pairs"):
                pairs, matching = choose_pairs(database, photos, options.matching,
                                               is_video(source), progress)
            progress.message(f"matching {matching}")
            with timed("matching"):
                match_pairs(database, pairs, progress)
        except RuntimeError as error:  # of SQLite in pycolmap, which gives no other reason
            raise InputError(f"{database}: cannot be written or read ({reason(error)}); check that "
                             "the disk has space, and give the command again") from error
        with timed("mapping"):
            mapped = unfinished.mapped(lambda: map_photos(database, cameras, len(photos), progress))
        model, placed, refusal = _placed(mapped, unfinished, photos, cameras, control)
        with timed("scene"):
            names = write_scene(output, model, photos, progress)
        write_orientation(output, placed.up)
        write_georeference(output, placed.georeference)
        if refusal and (options.control_points or options.crs):
            raise InputError(
                f"{output}: the scene is complete, but {placed.notes[0]}; correct this and give "
                "the command again, which goes on from here, or train the scene without a place")
        missing = reasons(database, photos, set(names), mapped.elsewhere, refused)
        record = {"version": __version__, "source": plain(source.resolve()),
                  "masks": kept["masks"], "matching": matching,
                  "levels": next((photo.levels for photo in photos if photo.levels), None),
                  **record_of(mapped, cameras, placed, missing), "seconds": seconds,
                  "resumed": resumed}
        write_object(output / RECORD, record)
        shutil.rmtree(unfinished.folder)
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
        count = sum(map(len, find_photos(source, Path(masks) if isinstance(masks, str) else None)))
        if record.get("photos") != count:
            raise InputError(f"{output}: was made of {record.get('photos')} photos of {source}, "
                             f"which now has {count}; remove it to make it again")
    return True


def _control(options: SfmOptions) -> ControlPoints:
    """The ground control points, and the CRS of the scene, "" if it is not given."""
    crs = scene_crs(options.crs) if options.crs else None
    return read_control_points(options.control_points, crs, options.check_points)


def _check_output(output: Path, sources: Iterable[Path | None], overwrite: bool) -> None:
    """InputError if the folder of a scene holds something that may not be replaced, or one of the
    sources from which the scene is made."""
    if not (output / UNFINISHED).is_dir():
        if (output / RECORD).exists():
            if not overwrite:
                raise InputError(f"{output}: holds a reconstructed scene already; give another "
                                 "folder, or --overwrite")
        elif output.exists() and (not output.is_dir() or {
                path.name for path in output.iterdir()} - {LOCK, HOLDER}):
            raise InputError(f"{output}: exists and was not made by `clsplat sfm`; give another "
                             "folder")
    for path in filter(None, sources):
        if path.resolve().is_relative_to(output.resolve()):
            raise InputError(f"{path}: is in {output}, whose files are replaced; give another "
                             "folder for the scene")


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
    levels = common_levels([photo.path for photo in photos],
                           [photo.metadata.is_deep for photo in photos])
    note = levels_note(levels)
    if note:
        progress.message(note)
    return [replace(photo, levels=each) for photo, each in zip(photos, levels)], refused


class Unfinished:
    """The folder .sfm of a scene, which is made, and in it that of the frames of a video."""

    def __init__(self, scene: Path) -> None:
        self.folder = scene / UNFINISHED
        self.frames = self.folder / "frames"
        make_folder(self.folder)

    def open(self, photos: Sequence[SourcePhoto], options: dict[str, Any], overwrite: bool) -> bool:
        """Begin or continue a reconstruction; whether it continues. InputError if the folder has
        what other photos or options left, which may not be overwritten.

        Parameters
        ----------
        options : on which features, matches and poses depend.
        """
        state = {"options": options, "photos": [
            [photo.name, photo.path.stat().st_size, str(photo.mask)] for photo in photos]}
        path = self.folder / STATE
        if path.exists():
            with suppress(OSError, ValueError):
                if object_of(read_regular(path)) == state:
                    return True
            if not overwrite:
                raise InputError(f"{self.folder.parent}: holds an unfinished reconstruction of "
                                 "other photos or with other options; give another folder, or "
                                 "--overwrite")
        # without a state, what is there was left by a command that was killed while it removed it
        self.forget()
        write_object(path, state)
        return False

    def forget(self) -> None:
        """Remove the scene, and all of this folder but the frames of a video; the state first."""
        (self.folder / STATE).unlink(missing_ok=True)
        kept = self.frames, self.folder / FRAMES_DONE
        for path in [*self.folder.iterdir(), *(self.folder.parent / name for name in WRITTEN)]:
            if path.is_dir() and path not in kept:
                shutil.rmtree(path)
            elif path not in kept:
                path.unlink(missing_ok=True)

    def mapped(self, compute: Callable[[], Mapped]) -> Mapped:
        """The reconstruction that is kept, or else the computed one, which is kept then."""
        kept, partial = self.folder / MODEL, self.folder / f"{MODEL}.part"
        if not kept.is_dir():
            result = compute()
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            write_reconstruction(partial, result.reconstruction)
            write_object(partial / MAPPED, {"method": result.method,
                                            "elsewhere": list(result.elsewhere)})
            partial.rename(kept)
        record = object_of(read_regular(kept / MAPPED))
        return Mapped(pycolmap.Reconstruction(kept), record["method"], tuple(record["elsewhere"]))


def _placed(mapped: Mapped, unfinished: Unfinished, photos: Sequence[SourcePhoto],
            cameras: Sequence[SourceCamera], control: ControlPoints
            ) -> tuple[pycolmap.Reconstruction, Placed, bool]:
    """The reconstruction in its place, what was found, and whether it has no place."""
    def named(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        for image in model.images.values():
            image.name = photos[image.image_id - 1].name
        return model

    metadata = {photo.name: photo.metadata for photo in photos}
    model = named(mapped.reconstruction)
    try:
        return model, place_reconstruction(model, metadata, control, adjusts=True,
                                           keep_focal=are_calibrated(cameras)), False
    except NotGeoreferenced as error:
        model = named(pycolmap.Reconstruction(unfinished.folder / MODEL))  # before an adjustment
        return model, turned(model, metadata, error), True
