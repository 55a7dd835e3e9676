"""The photos of a folder and of its subfolders, their masks, and which share a camera."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from clsplat.errors import InputError
from clsplat.io.photos.decoded import RAW_SUFFIXES
from clsplat.io.photos.images import image_size
from clsplat.io.photos.masks import FOLDERS, MaskFiles, check_shape, mask_folders, photo_of
from clsplat.io.photos.metadata import Calibration, PhotoMetadata, read_metadata
from clsplat.io.photos.photo import Levels
from clsplat.io.runs.run import CITY, OPTIONS
from clsplat.io.scenes.sources import IMAGES, PHOTO_SUFFIXES

UNREAD = (".avif", ".insp")
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".mpg", ".mpeg", ".wmv")
RECORD, UNFINISHED = "sfm.json", ".sfm"  # in the folder of a scene that was made of photos
WRITTEN = (RECORD, UNFINISHED, OPTIONS, CITY)  # of which a folder that clsplat writes has one
LEAST_PHOTOS = 3
LEAST_FOR_OPENCV = 8  # photos of a camera; fewer do not determine all parameters of the model
DEFAULT_FOCAL = 1.2  # of the long side of a photo, COLMAP's value where nothing is known


@dataclass(frozen=True)
class SourcePhoto:
    """A photo from which a scene is reconstructed: its name within the folder, with slashes, its
    file, what its header holds, the file of its mask, and levels as of `scene.View`."""

    name: str
    path: Path
    metadata: PhotoMetadata
    mask: Path | None = None
    levels: Levels | None = None


@dataclass(frozen=True)
class SourceCamera:
    """What is known of a camera before the reconstruction."""

    model: str  # COLMAP's name of the camera model
    # width, height: pixels of its photos as stored
    width: int
    height: int
    focal: float  # pixels, an estimate
    focal_known: bool  # whether the estimate comes from metadata
    calibration: Calibration | None  # by the maker, or None
    photos: tuple[int, ...]  # indices of its photos
    is_chosen: bool = False  # whether the user has chosen the model, which is then kept


def has_photos(folder: Path) -> bool:
    """Whether a folder, its images/ or one of its other subfolders has a photo."""
    return folder.is_dir() and any(map(_is_photo, _files(folder)))


def is_video(path: Path) -> bool:
    """Whether a path is that of a video, by its suffix."""
    return path.suffix.lower() in VIDEOS and not path.is_dir()


def find_photos(folder: Path, masks: Path | None = None) -> tuple[list[SourcePhoto], dict[str, str]]:
    """Find the photos of a folder and its subfolders, sorted by name. Subfolders that clsplat has
    written are left out.

    Parameters
    ----------
    masks : a folder with masks NAME.png, or NAME.jpg.png as COLMAP names them; None: those that
        io/photos/masks.py finds.

    Returns
    -------
    The photos; and the reasons, by name, why others cannot be used.

    Raises
    ------
    InputError : there are fewer than three, or a mask for none of them; a mask does not fit.
    """
    root = _photo_root(folder)
    if masks is not None and not masks.is_dir():
        raise InputError(f"--masks {masks}: no such folder; give one with masks NAME.png")
    beside = [masks] if masks is not None else mask_folders(folder) if root != folder else []
    files = MaskFiles(beside, beside=masks is None)
    photos, refused = [], {}
    paths = sorted(_files(root, masks), key=lambda path: path.relative_to(root).as_posix())
    rendered = {path.with_suffix("") for path in paths if _is_photo(path) and path.suffix.lower() not in RAW_SUFFIXES}
    for path in paths:
        if path.suffix.lower() in (*UNREAD, *RAW_SUFFIXES) and path.with_suffix("") in rendered:
            continue  # a camera may write each photo in both formats
        given = path.relative_to(root).as_posix()
        name = given.encode(errors="replace").decode()
        if path.suffix.lower() in UNREAD:
            refused[name] = "its format is not read: convert it to JPEG"
        if not _is_photo(path) or photo_of(path.name):
            continue
        if name != given:  # two such names may look the same
            refused[name] = "its name is not UTF-8: rename it"
            continue
        try:
            metadata = read_metadata(path)
        except InputError as error:
            refused[name] = str(error)
            continue
        mask = files.of(name, path)
        if mask is not None:
            check_shape(mask, "mask", image_size(mask), (metadata.width, metadata.height))
        photos.append(SourcePhoto(name, path, metadata, mask))
    if len(photos) < LEAST_PHOTOS:
        why = f"; {next(iter(refused.values()))}" if refused else ""
        raise InputError(
            f"{folder}: {len(photos)} photos that can be read, and a reconstruction "
            f"needs at least {LEAST_PHOTOS}, better 20 or more{why}"
        )
    if beside and not any(photo.mask for photo in photos):
        raise InputError(
            f"{'--masks ' if masks else ''}{beside[0]}: has a mask for none of the "
            "photos; name them as the photos, with .png as the suffix or after it"
        )
    return photos, refused


def _photo_root(folder: Path) -> Path:
    """The folder below which photos are searched: images/ if the folder itself has none."""
    if not folder.is_dir():
        what = "is neither a folder nor a video" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: {what}; give a folder with photos, or a video")
    if not any(_is_photo(path) and not photo_of(path.name) for path in folder.iterdir()) and (folder / IMAGES).is_dir():
        return folder / IMAGES
    return folder


def _is_photo(path: Path) -> bool:
    return path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")


def _files(root: Path, masks: Path | None = None) -> Iterator[Path]:
    """The files below a folder, except those in hidden folders, in folders of masks, and in scenes
    and runs, which may have been written beside the photos."""
    for folder, names, files in os.walk(root):
        below = [Path(folder) / name for name in names]
        names[:] = [
            path.name
            for path in below
            if path.name[0] != "."
            and path.name.lower() not in FOLDERS
            and not (masks and path.samefile(masks))
            and not any((path / mark).exists() for mark in WRITTEN)
        ]
        yield from (Path(folder) / name for name in files)


def cameras_of(photos: list[SourcePhoto], model: str = "") -> list[SourceCamera]:
    """The cameras of photos. Photos share one if they have the same size and come from the same
    body and lens; where files do not name these, from the same subfolder.

    Parameters
    ----------
    model : COLMAP's name of the camera model for all; "": by what is known of each camera.
    """
    groups: dict[object, list[int]] = {}
    for index, photo in enumerate(photos):
        data = photo.metadata
        body: object = (data.camera, data.lens, data.calibration)
        if not data.camera:
            body = photo.name.rpartition("/")[0]
        groups.setdefault((data.width, data.height, body), []).append(index)
    return [_camera(photos, rows, model) for rows in groups.values()]


def are_calibrated(cameras: Iterable[SourceCamera]) -> bool:
    """Whether the maker has calibrated all cameras, whose focal lengths are then kept: photos of
    flat ground from one height do not determine them."""
    return all(camera.calibration is not None for camera in cameras)


def _camera(photos: list[SourcePhoto], rows: list[int], model: str) -> SourceCamera:
    data, is_chosen = photos[rows[0]].metadata, bool(model)
    calibration = data.calibration if model in ("", "OPENCV") else None
    focals = sorted(value for row in rows if (value := photos[row].metadata.focal_pixels))
    focal = focals[len(focals) // 2] if focals else DEFAULT_FOCAL * max(data.width, data.height)
    if calibration is not None:
        model, focal = "OPENCV", sum(calibration[:2]) / 2
    elif not model:
        model = "OPENCV" if len(rows) >= LEAST_FOR_OPENCV else "SIMPLE_RADIAL"
    return SourceCamera(
        model,
        data.width,
        data.height,
        focal,
        bool(focals) or calibration is not None,
        calibration,
        tuple(rows),
        is_chosen,
    )
