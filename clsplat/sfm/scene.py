"""Writes a reconstruction as a scene: its photos and masks as they are, and a sparse model.

The model has the cameras of the photos with their lens distortion, which is removed where a photo
is first needed (io/photos/undistort.py).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.io.ahead import called_ahead
from clsplat.io.folders import link_file, make_folder
from clsplat.io.photos.images import read_image
from clsplat.io.photos.mask_files import MASKS
from clsplat.io.scenes.colmap import write_reconstruction
from clsplat.io.scenes.sources import IMAGES
from clsplat.sfm.features import threads
from clsplat.sfm.photos import SourcePhoto
from clsplat.sfm.progress import Progress


def write_scene(folder: Path, reconstruction: Any, photos: Sequence[SourcePhoto],
                progress: Progress) -> list[str]:
    """Write images/, masks/ and sparse/0 of a scene.

    Photos and masks are hard links, so that the scene outlives its source without a second copy on
    the disk; on another file system they are copied. What is there already stays, so a killed
    command continues.

    Parameters
    ----------
    folder : of the scene.
    reconstruction : a pycolmap.Reconstruction whose images have the names of photos; its points get
        their colours.

    Returns
    -------
    The names of the registered photos, sorted.
    """
    by_name = {photo.name: photo for photo in photos}
    images = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    for name in sorted(images):
        link_file(by_name[name].path, folder / IMAGES / name, "hard")
        mask = by_name[name].mask
        if mask is not None:
            link_file(mask, folder / MASKS / (name + mask.suffix), "hard")
    _add_colours(reconstruction, {name: by_name[name] for name in sorted(images)}, images, progress)
    make_folder(folder / "sparse" / "0")
    write_reconstruction(folder / "sparse" / "0", reconstruction)
    return sorted(images)


def _add_colours(reconstruction: Any, photos: Mapping[str, SourcePhoto], images: Mapping[str, Any],
                 progress: Progress) -> None:
    """Give each point the mean colour of the pixels at which photos observe it."""
    numbers = sorted(reconstruction.point3D_ids())
    sums, counts = np.zeros((len(numbers), 3)), np.zeros(len(numbers), np.int64)

    def observed(name: str) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """The rows of points, and their pixels."""
        pixels = read_image(photos[name].path, levels=photos[name].levels)
        seen = [point for point in images[name].points2D if point.has_point3D()]
        rows = np.searchsorted(numbers, [point.point3D_id for point in seen])
        at = np.array([point.xy for point in seen]).reshape(-1, 2).astype(int)
        x, y = np.clip(at, 0, (pixels.shape[1] - 1, pixels.shape[0] - 1)).T
        return rows, pixels[y, x]

    # few at once, since each has a whole photo in memory
    found = called_ahead(observed, zip(photos), threads(), threads() + 1)
    for done, (rows, pixels) in enumerate(found, 1):
        np.add.at(sums, rows, pixels)
        np.add.at(counts, rows, 1)
        progress.count("colours of photo", done, len(photos))
    means = (sums / np.maximum(counts, 1)[:, None] + 0.5).astype(np.uint8)
    for number, colour in zip(numbers, means):
        reconstruction.point3D(number).color = colour
