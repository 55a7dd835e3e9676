"""COLMAP models as pycolmap reads them, of which it fails on some that others read."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from clsplat.io.scenes.colmap_format import Camera, Image, Points
from clsplat.io.scenes.colmap_model import model_parts


def read_reconstruction(model: Path) -> pycolmap.Reconstruction:
    """Read a model that `colmap_model.model_arrays` has passed.

    pycolmap cuts names in a text at their first blank. It does not read tracks whose images lack
    their observations, which then become the projections of the points.
    """
    cameras, images, points = model_parts(model, ("points3D",))
    try:
        reconstruction = pycolmap.Reconstruction(model)
    except IndexError:
        reconstruction = _rebuilt(cameras, images, points)
    for image in images:
        reconstruction.images[image.number].name = image.name
    return reconstruction


def _rebuilt(cameras: dict[int, Camera], images: Sequence[Image], points: Points
             ) -> pycolmap.Reconstruction:
    seen: defaultdict[int, list[int]] = defaultdict(list)  # ids of points by image
    rows = []
    for number, position, colour, track in zip(
            points.ids.tolist(), points.positions.tolist(), points.colours.tolist(),
            np.split(points.images, np.cumsum(points.lengths)[:-1])):
        row = [number, *position, *colour, 0.5]
        for image in track.tolist():
            row += [image, len(seen[image])]
            seen[image].append(number)
        rows.append(row)
    with TemporaryDirectory() as folder:
        for part, lines in (
                ("cameras", [[number, camera.model, camera.width, camera.height,
                              *camera.parameters] for number, camera in cameras.items()]),
                ("images", [line for image in images for line in (
                    [image.number, *image.quaternion, *image.translation, image.camera,
                     image.number],
                    [word for number in seen[image.number] for word in (0, 0, number)])]),
                ("points3D", rows)):
            text = "\n".join(" ".join(map(str, line)) for line in lines)
            (Path(folder) / f"{part}.txt").write_text(text + "\n", encoding="utf-8")
        reconstruction = pycolmap.Reconstruction(folder)
    for image in reconstruction.images.values():
        for point in image.points2D:
            pixel = image.project_point(reconstruction.points3D[point.point3D_id].xyz)
            point.xy = np.zeros(2) if pixel is None else pixel
    return reconstruction
