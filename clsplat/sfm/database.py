"""COLMAP's database of a reconstruction: cameras and photos, which features and matches join.

Photos are named by their number there, since COLMAP's lists of pairs are separated by spaces.
"""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pycolmap

from clsplat.sfm.photos import SourceCamera


def image_id(index: int) -> int:
    """The id of a photo in the database, by its index."""
    return index + 1


def image_name(index: int) -> str:
    """The name of a photo in the database, by its index."""
    return f"{index:08d}"


def partners(path: Path) -> Counter[int]:
    """With how many photos each photo, by its id, shares features that two views can have."""
    with pycolmap.Database.open(path) as database:
        return Counter(number for pair, inliers in zip(
            *database.read_two_view_geometry_num_inliers()) if inliers
            for number in pycolmap.pair_id_to_image_pair(pair))


def create_database(path: Path, cameras: Sequence[SourceCamera]) -> None:
    """Create a database with cameras and photos; it appears whole or not at all."""
    partial = path.with_name(path.name + ".part")
    for left in path.parent.glob(partial.name + "*"):  # SQLite keeps two files beside it
        left.unlink()
    with pycolmap.Database.open(partial) as database:
        for number, source in enumerate(cameras, 1):
            database.write_camera(camera_of(number, source), use_camera_id=True)
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
            rig = pycolmap.Rig()
            rig.rig_id = number
            rig.add_ref_sensor(sensor)
            database.write_rig(rig, use_rig_id=True)
            for index in source.photos:
                image = pycolmap.Image(name=image_name(index), camera_id=number)
                frame = pycolmap.Frame()
                image.image_id = frame.frame_id = image_id(index)
                frame.rig_id = number
                frame.add_data_id(pycolmap.data_t(sensor, image.image_id))
                database.write_image(image, use_image_id=True)
                database.write_frame(frame, use_frame_id=True)
    os.replace(partial, path)


def camera_of(number: int, source: SourceCamera) -> pycolmap.Camera:
    """The camera of the database with this id, as far as it is known."""
    camera = pycolmap.Camera.create_from_model_name(
        number, source.model, source.focal, source.width, source.height)
    camera.has_prior_focal_length = source.focal_known
    if source.calibration is not None:
        camera.params = [*source.calibration.focal, *source.calibration.centre,
                         *source.calibration.distortion[:4]]
    return camera
