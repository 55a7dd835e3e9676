"""Makes a scene from a folder of photos: the pipeline, step by step.

What is unfinished lies in the folder .sfm of the scene, so that a killed command continues.
"""

import shutil
import time
from collections.abc import Container, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from clsplat import __version__
from clsplat.device import choose_device
from clsplat.errors import InputError, reason
from clsplat.io.folders import link_file, make_folder
from clsplat.io.georeference.adjustment import check_marks
from clsplat.io.georeference.control_points import read_control_points
from clsplat.io.georeference.crs import scene_crs
from clsplat.io.georeference.files import write_georeference, write_orientation
from clsplat.io.georeference.reconstruction import Placed, place_reconstruction, turned
from clsplat.io.lock import HOLDER, LOCK, exclusive
from clsplat.io.photos.masks import MASKS
from clsplat.io.photos.mrk import with_mrk
from clsplat.io.photos.photo import common_levels
from clsplat.io.records import object_of, plain, read_object, write_object
from clsplat.io.regular import read_regular
from clsplat.io.scenes.colmap import write_reconstruction
from clsplat.io.scenes.colmap_files import CAMERA_MODELS
from clsplat.io.scenes.sources import IMAGES
from clsplat.placement.plausible import NotGeoreferenced
from clsplat.sfm import features
from clsplat.sfm import photos as inputs
from clsplat.sfm.lenses import lens_doubts
from clsplat.sfm.mapping import keep_model, map_photos
from clsplat.sfm.pairs import choose_pairs
from clsplat.sfm.photos import SourceCamera, SourcePhoto, find_photos, is_video
from clsplat.sfm.progress import Progress
from clsplat.sfm.two_views import match_pairs
from clsplat.sfm.video import check_video, extract_frames

WRITTEN = (IMAGES, MASKS, "sparse", "georeference.json", "orientation.json")
STATE = "state.json"  # in the folder .sfm
FEW_FEATURES = 100


@dataclass(frozen=True)
class SfmOptions:
    """Options of a reconstruction."""

    masks: Path | None = None  # a folder of masks, see `find_photos`, or None
    matching: str = "auto"  # which pairs are matched, as for `pairs.choose_pairs`
    camera_model: str = ""  # COLMAP's name of the camera model; "": by what is known of each camera
    frames: int = 200  # of a video, how many are used
    crs: str = ""  # coordinate reference system of the scene; "": the UTM zone
    # a file of ground control points, to which cameras and points are adjusted, or None
    control_points: Path | None = None
    check_points: tuple[str, ...] = ()  # names of those that take no part and show the error
    max_features: int = 8192  # of a photo; of more, the largest are kept
    device: str = "auto"  # on which features are found and matched, as for `clsplat.Device`


def reconstruct(
    source: Path, output: Path, options: SfmOptions, progress: Progress, overwrite: bool = False
) -> dict[str, Any]:
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
        raise InputError(
            f"--camera-model {options.camera_model}: is none of "
            f"{', '.join(sorted(models))}; leave it out, or give one of them"
        )
    crs = scene_crs(options.crs) if options.crs else None
    control = read_control_points(options.control_points, crs, options.check_points)
    _check_output(output, (source, options.masks), overwrite)
    start = time.monotonic()
    found = _photos(source, options, progress)
    if found is not None:
        check_marks(control.points, {photo.name for photo in found[0]})
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(0)
    make_folder(output)
    with exclusive(output):
        unfinished = Unfinished(output)
        if overwrite and (output / inputs.RECORD).exists():
            unfinished.forget()
        (output / inputs.RECORD).unlink(missing_ok=True)
        if found is None:
            extract_frames(source, unfinished.frames, options.frames, progress)
            found = find_photos(unfinished.frames)
        photos, refused = found
        cameras = inputs.cameras_of(photos, options.camera_model)
        masks = options.masks and str(options.masks.resolve())
        unfinished.open(
            photos,
            {
                "masks": masks,
                "matching": options.matching,
                "max_features": options.max_features,
                "camera_model": options.camera_model,
            },
            overwrite,
        )
        database = unfinished.folder / "database.db"
        method = "sequence" if is_video(source) and options.matching == "auto" else options.matching
        damaged, matching = _match(database, photos, cameras, method, options, progress)
        if not unfinished.has_model:
            unfinished.keep(map_photos(database, cameras, len(photos), progress), photos)
        model, metadata = unfinished.model(), {photo.name: photo.metadata for photo in photos}
        has_place = True
        try:
            placed = place_reconstruction(
                model, metadata, control, adjusts=True, keep_focal=inputs.are_calibrated(cameras)
            )
        except NotGeoreferenced as error:
            model, has_place = unfinished.model(), False  # without an adjustment
            placed = turned(model, metadata, error)
        names = write_scene(output, model, photos, progress)
        write_orientation(output, placed.up)
        write_georeference(output, placed.georeference)
        if not has_place and (options.control_points or options.crs):
            raise InputError(
                f"{output}: the scene is complete, but {placed.notes[0]}; correct this and give "
                "the command again, which goes on from here, or train the scene without a place"
            )
        record = {
            "version": __version__,
            "source": plain(source.resolve()),
            "masks": masks,
            "matching": matching,
            "levels": next((photo.levels for photo in photos if photo.levels), None),
            **_facts(model, cameras, placed),
            "photos": len(photos) + len(refused),
            "not_registered": {**refused, **damaged, **reasons(database, photos, {*names, *damaged})},
            "seconds": round(time.monotonic() - start, 1),
        }
        write_object(output / inputs.RECORD, record)
        shutil.rmtree(unfinished.folder)
    return record


def _match(
    database: Path,
    photos: Sequence[SourcePhoto],
    cameras: Sequence[SourceCamera],
    method: str,
    options: SfmOptions,
    progress: Progress,
) -> tuple[dict[str, str], str]:
    """Fill the database; why photos cannot be used, by name, and which pairs were matched."""
    device = choose_device(options.device)
    try:
        if not database.exists():
            features.create_database(database, cameras)
        damaged = features.extract_features(database, photos, device, options.max_features, progress)
        pairs, why = choose_pairs(database, photos, method, device, progress)
        progress.message(f"matching {why}")
        match_pairs(database, pairs, device, progress)
    except RuntimeError as error:  # of SQLite in pycolmap, which gives no other reason
        raise InputError(
            f"{database}: cannot be written or read ({reason(error)}); check that "
            "the disk has space, and give the command again"
        ) from error
    return damaged, why


def is_finished(output: Path, source: Path) -> bool:
    """Whether a folder holds the finished scene of these photos or this video; InputError if it is
    that of others, or photos were added or removed since."""
    path = output / inputs.RECORD
    if not path.exists():
        return False
    record = read_object(path, {}, f"remove {output}")
    made_of, masks = record.get("source"), record.get("masks")
    if made_of != plain(source.resolve()):
        raise InputError(f"{output}: was made of {made_of}, not of {source}; remove it, or give another -o")
    if not is_video(source):
        count = sum(map(len, find_photos(source, Path(masks) if isinstance(masks, str) else None)))
        if record.get("photos") != count:
            raise InputError(
                f"{output}: was made of {record.get('photos')} photos of {source}, "
                f"which now has {count}; remove it to make it again"
            )
    return True


def _check_output(output: Path, sources: Iterable[Path | None], overwrite: bool) -> None:
    """InputError if the folder of a scene holds something that may not be replaced, or one of the
    sources from which the scene is made."""
    if not (output / inputs.UNFINISHED).is_dir():
        if (output / inputs.RECORD).exists():
            if not overwrite:
                raise InputError(f"{output}: holds a reconstructed scene already; give another folder, or --overwrite")
        elif output.exists() and (not output.is_dir() or {path.name for path in output.iterdir()} - {LOCK, HOLDER}):
            raise InputError(f"{output}: exists and was not made by `clsplat sfm`; give another folder")
    for path in filter(None, sources):
        if path.resolve().is_relative_to(output.resolve()):
            raise InputError(f"{path}: is in {output}, whose files are replaced; give another folder for the scene")


def _photos(source: Path, options: SfmOptions, progress: Progress) -> tuple[list[SourcePhoto], dict[str, str]] | None:
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
    levels, notes = common_levels([photo.path for photo in photos], [photo.metadata.is_deep for photo in photos])
    known, found = with_mrk((photo.path, photo.metadata) for photo in photos)
    for note in (*notes, *found):
        progress.message(note)
    return [
        replace(photo, levels=each, metadata=metadata) for photo, each, metadata in zip(photos, levels, known)
    ], refused


class Unfinished:
    """The folder .sfm of a scene, which is made, and in it that of the frames of a video."""

    def __init__(self, scene: Path) -> None:
        self.folder = scene / inputs.UNFINISHED
        self.frames, self._model = self.folder / "frames", self.folder / "model"
        make_folder(self.folder)

    def open(self, photos: Sequence[SourcePhoto], options: dict[str, Any], overwrite: bool) -> None:
        """Begin or continue a reconstruction; InputError if the folder has what other photos or
        options, on which features, matches and poses depend, left and may not be overwritten."""
        state = {
            "options": options,
            "photos": [[photo.name, photo.path.stat().st_size, str(photo.mask)] for photo in photos],
        }
        path = self.folder / STATE
        if path.exists():
            with suppress(OSError, ValueError):
                if object_of(read_regular(path)) == state:
                    return
            if not overwrite:
                raise InputError(
                    f"{self.folder.parent}: holds an unfinished reconstruction of "
                    "other photos or with other options; give another folder, or "
                    "--overwrite"
                )
        # without a state, what is there was left by a command that was killed while it removed it
        self.forget()
        write_object(path, state)

    def forget(self) -> None:
        """Remove the scene, and all of this folder but the frames of a video; the state first."""
        (self.folder / STATE).unlink(missing_ok=True)
        for path in [*self.folder.iterdir(), *(self.folder.parent / name for name in WRITTEN)]:
            if path.is_dir() and path != self.frames:
                shutil.rmtree(path)
            elif path.is_file():
                path.unlink()

    @property
    def has_model(self) -> bool:
        """Whether the photos are mapped."""
        return self._model.is_dir()

    def keep(self, model: pycolmap.Reconstruction, photos: Sequence[SourcePhoto]) -> None:
        """Keep a reconstruction, whose images get the names of their photos."""
        for image in model.images.values():
            image.name = photos[image.image_id - features.image_id(0)].name
        keep_model(self._model, model)

    def model(self) -> pycolmap.Reconstruction:
        """The reconstruction that is kept."""
        return pycolmap.Reconstruction(self._model)


def write_scene(folder: Path, reconstruction: Any, photos: Sequence[SourcePhoto], progress: Progress) -> list[str]:
    """Write images/, masks/ and sparse/0 of a scene, and give points their colours; the names of
    the registered photos, sorted.

    Photos and masks are hard links, so that the scene outlives its source without a second copy on
    the disk; on another file system they are copied. What is there already stays. The model has the
    cameras of the photos with their lens distortion.
    """
    by_name = {photo.name: photo for photo in photos}
    names = sorted(image.name for image in reconstruction.images.values() if image.has_pose)
    for name in names:
        link_file(by_name[name].path, folder / IMAGES / name, "hard")
        mask = by_name[name].mask
        if mask is not None:
            link_file(mask, folder / MASKS / (name + mask.suffix), "hard")
    progress.phase("colours of points")
    reconstruction.extract_colors_for_all_images(folder / IMAGES)
    make_folder(folder / "sparse" / "0")
    write_reconstruction(folder / "sparse" / "0", reconstruction)
    return names


def _facts(model: pycolmap.Reconstruction, cameras: Sequence[SourceCamera], placed: Placed) -> dict[str, Any]:
    """What sfm.json has on a reconstruction; `cameras` as they were known before."""
    known = placed.georeference
    control = known.residuals if known is not None and known.kind == "gcp" else ()
    record: dict[str, Any] = plain(
        {
            "registered": model.num_reg_images(),
            "points": model.num_points3D(),
            "mean_track_length": model.compute_mean_track_length(),
            "reprojection_error_pixels": model.compute_mean_reprojection_error(),
            "cameras": [
                {
                    "model": model.cameras[number].model_name,
                    "width": source.width,
                    "height": source.height,
                    "parameters": model.cameras[number].params,
                    "photos": len(source.photos),
                }
                for number, source in enumerate(cameras, 1)
                if number in model.cameras
            ],
            "georeferenced": known is not None,
            "up": placed.up,
            "control_points": list(map(asdict, control)),
            "notes": placed.notes,
            "position_priors": placed.priors and {**asdict(placed.priors), "text": str(placed.priors)},
            "warnings": [*placed.warnings, *lens_doubts(model, cameras)],
        }
    )
    return record


def reasons(database: Path, photos: Sequence[SourcePhoto], others: Container[str]) -> dict[str, str]:
    """Why photos, except `others`, were not registered, by name."""
    matches, result = features.partners(database), {}
    with pycolmap.Database.open(database) as source:
        for number, photo in enumerate(photos, features.image_id(0)):
            if photo.name not in others:
                found = source.num_keypoints_for_image(number)
                result[photo.name] = (
                    f"has only {found} features: it is blurred or shows hardly any detail"
                    if found < FEW_FEATURES
                    else f"matches {matches[number]} photos, but nothing joins it to the largest part of the scene"
                    if matches[number]
                    else "matches no other photo"
                )
    return result
