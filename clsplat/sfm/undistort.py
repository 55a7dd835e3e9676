"""Writes a reconstruction as a scene: photos without lens distortion, masks, and a sparse model.

Photos that EXIF turns are turned upright here, with their cameras: before, all photos of a camera
are used as they are stored, so that they share their lens.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.io.folders import make_folder
from clsplat.io.photos.images import read_image, write_image
from clsplat.io.photos.mask_files import MASKS
from clsplat.io.photos.masks import LEAST_BRIGHT, read_mask, unmasked
from clsplat.io.regular import native
from clsplat.io.scenes.colmap_write import Tracks, write_colmap
from clsplat.io.scenes.sources import IMAGES
from clsplat.scene import View
from clsplat.sfm.features import threads
from clsplat.sfm.photos import SourcePhoto
from clsplat.sfm.progress import Progress

QUALITY = 95  # of JPEG
KEPT = (".jpg", ".jpeg", ".png")  # other photos are written as PNG


@dataclass(frozen=True, eq=False)
class Registered:
    """A photo of a reconstruction, and what becomes of it.

    Attributes
    ----------
    photo : as it was taken.
    image : its pycolmap.Image.
    distorted, pinhole : its pycolmap.Camera before and after undistortion.
    quarters : clockwise quarter turns that show it upright.
    name : of its file in the scene.
    """

    photo: SourcePhoto
    image: Any
    distorted: Any
    pinhole: Any
    quarters: int
    name: str

    def view(self, folder: Path) -> View:
        """The view of the scene in this folder."""
        pose = self.image.cam_from_world()
        fx, fy, cx, cy = self.pinhole.params.tolist()
        camera = Camera(self.pinhole.width, self.pinhole.height, (fx, fy), (cx, cy),
                        pose.rotation.matrix(), pose.translation.copy()).turned(self.quarters)
        return View(self.name, camera, folder / IMAGES / native(self.name))

    def pixels(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where places float64[N, 2] of the photo as stored are in the scene's photo."""
        rays = self.distorted.cam_from_img(places)
        x, y = np.asarray(self.pinhole.img_from_cam(
            np.column_stack([rays, np.ones(len(rays))]))).reshape(-1, 2).T
        width, height = self.pinhole.width, self.pinhole.height
        for _ in range(self.quarters):
            x, y, width, height = height - y, x, height, width
        return np.column_stack([x, y])


def write_scene(folder: Path, reconstruction: Any, photos: Sequence[SourcePhoto],
                progress: Progress) -> list[str]:
    """Write images/, masks/ and sparse/0 of a scene.

    Photos that are there already are not written again, so a killed command continues.

    Parameters
    ----------
    folder : of the scene.
    reconstruction : a pycolmap.Reconstruction whose images have the names of photos.

    Returns
    -------
    The names of the photos of the scene as they were before, in the order of the model.
    """
    registered = sorted(_registered(reconstruction, photos), key=lambda item: item.name)
    for parent in {(folder / kind / native(item.name)).parent for item in registered
                   for kind in (IMAGES, *([MASKS] if item.photo.mask else []))}:
        make_folder(parent)
    points = _Points(reconstruction, registered)

    def one(item: Registered) -> NDArray[np.uint8]:
        return _photo(item, folder)

    with ThreadPoolExecutor(threads()) as pool:
        # few at once, since each has a whole photo in memory
        for begin in range(0, len(registered), threads()):
            some = registered[begin:begin + threads()]
            for index, pixels in enumerate(pool.map(one, some), begin):
                points.add_colours(index, pixels)
                progress.count("undistorting photo", index + 1, len(registered))
    write_colmap(folder / "sparse" / "0", [item.view(folder) for item in registered],
                 points.places, points.colours(), points.tracks)
    return [item.photo.name for item in registered]


def _registered(reconstruction: Any, photos: Sequence[SourcePhoto]) -> Iterator[Registered]:
    by_name = {photo.name: photo for photo in photos}
    names = output_names([photo.name for photo in photos])
    options = pycolmap.UndistortCameraOptions()
    pinholes = {number: pycolmap.undistort_camera(options, camera)
                for number, camera in reconstruction.cameras.items()}
    for image in reconstruction.images.values():
        if image.has_pose:
            photo = by_name[image.name]
            yield Registered(photo, image, reconstruction.cameras[image.camera_id],
                             pinholes[image.camera_id],
                             photo.metadata.quarter_turns, names[image.name])


def output_names(names: Sequence[str]) -> dict[str, str]:
    """The names of the files in which photos are written: their own, if the format can be written.
    """
    result = {name: name for name in names if PurePosixPath(name).suffix.lower() in KEPT}
    for name in names:
        if name not in result:
            short = str(PurePosixPath(name).with_suffix(".png"))
            result[name] = f"{name}.png" if short in result.values() else short
    return result


def _photo(item: Registered, folder: Path) -> NDArray[np.uint8]:
    """The pixels of a photo of the scene, whose file and mask are written if they are missing."""
    path = folder / IMAGES / native(item.name)
    mask = folder / MASKS / native(item.name + ".png")
    if item.photo.mask is not None and not mask.exists():
        size = item.distorted.width, item.distorted.height
        valid = unmasked(read_mask(item.photo.mask, item.photo.mask, size), size)
        sure = _undistorted(item, valid[:, :, None] * np.uint8(255)) >= LEAST_BRIGHT
        write_image(mask, sure * np.uint8(255))
    if not path.exists():
        pixels = read_image(item.photo.path, levels=item.photo.levels)
        write_image(path, _undistorted(item, pixels), QUALITY)
    return read_image(path)  # as the file has it, so that a continued command sees the same


def _undistorted(item: Registered, pixels: NDArray[Any]) -> NDArray[np.uint8]:
    coloured = np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)), np.uint8)
    bitmap, _ = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(coloured), item.distorted)
    return np.ascontiguousarray(np.rot90(bitmap.to_array(), -item.quarters))


class _Points:
    """The points of a reconstruction with their observations in undistorted photos."""

    def __init__(self, reconstruction: Any, registered: Sequence[Registered]) -> None:
        numbers = sorted(reconstruction.point3D_ids())
        self.places = np.array([reconstruction.point3D(number).xyz for number in numbers],
                               np.float64).reshape(-1, 3)
        row_of = {number: row for row, number in enumerate(numbers)}
        rows, views, pixels = [], [], []
        for index, item in enumerate(registered):
            seen = [point for point in item.image.points2D if point.has_point3D()]
            rows.append(np.array([row_of[point.point3D_id] for point in seen], np.int64))
            views.append(np.full(len(seen), index))
            pixels.append(item.pixels(np.array([point.xy for point in seen]).reshape(-1, 2)))
        self.tracks = Tracks(np.concatenate(rows), np.concatenate(views), np.concatenate(pixels))
        self._sums = np.zeros((len(numbers), 3))
        self._counts = np.zeros(len(numbers), np.int64)

    def add_colours(self, index: int, pixels: NDArray[np.uint8]) -> None:
        """Add the pixels float[H, W, 3] of a photo, by its index, to the colours of its points."""
        rows = np.flatnonzero(self.tracks.views == index)
        column, line = np.floor(self.tracks.pixels[rows]).astype(int).T
        height, width = pixels.shape[:2]
        inside = (column >= 0) & (line >= 0) & (column < width) & (line < height)
        points = self.tracks.points[rows[inside]]
        np.add.at(self._sums, points, pixels[line[inside], column[inside]])
        np.add.at(self._counts, points, 1)

    def colours(self) -> NDArray[np.uint8]:
        """The mean colours uint8[N, 3]; black for points that undistortion has cut off."""
        means = self._sums / np.maximum(self._counts, 1)[:, None]
        return np.asarray(means + 0.5, np.uint8)
