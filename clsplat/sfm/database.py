"""COLMAP's database of a reconstruction: cameras and photos, which features and matches join.

Photos are named by their number there, since COLMAP's lists of pairs are separated by spaces.
"""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pycolmap

from clsplat.sfm.photos import SourceCamera


def image_name(index: int) -> str:
    """The name of a photo in the database, by its index."""
    return f"{index:08d}"


def image_id(index: int) -> int:
    """The id of a photo in the database, by its index."""
    return index + 1


def photo_index(number: int) -> int:
    """The index of a photo, by its id in the database."""
    return number - 1


def partners(path: Path) -> Counter[int]:
    """With how many photos each photo, by its index, shares features that two views can have."""
    database, result = pycolmap.Database.open(path), Counter[int]()
    try:
        for pair, inliers in zip(*database.read_two_view_geometry_num_inliers()):
            for number in pycolmap.pair_id_to_image_pair(pair) if inliers else ():
                result[photo_index(number)] += 1
    finally:
        database.close()
    return result


def create_database(path: Path, cameras: Sequence[SourceCamera]) -> None:
    """Create a database with cameras and photos; it appears whole or not at all."""
    partial = path.with_name(path.name + ".part")
    for left in path.parent.glob(partial.name + "*"):  # SQLite keeps two files beside it
        left.unlink()
    database = pycolmap.Database.open(partial)
    for number, source in enumerate(cameras, 1):
        database.write_camera(camera_of(number, source), use_camera_id=True)
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
        rig = pycolmap.Rig()
        rig.rig_id = number
        rig.add_ref_sensor(sensor)
        database.write_rig(rig, use_rig_id=True)
        for index in source.photos:
            _write_photo(database, index, number, sensor)
    database.close()
    os.replace(partial, path)


def camera_of(number: int, source: SourceCamera) -> pycolmap.Camera:
    """The camera of the database with this id, as far as it is known."""
    camera = pycolmap.Camera.create_from_model_name(
        number, source.model, source.focal, source.width, source.height)
    camera.has_prior_focal_length = source.focal_known
    if source.calibration is not None:
        k1, k2, p1, p2, _ = source.calibration.distortion
        camera.params = [*source.calibration.focal, *source.calibration.centre, k1, k2, p1, p2]
    return camera


def _write_photo(database: pycolmap.Database, index: int, camera: int,
                 sensor: pycolmap.sensor_t) -> None:
    image = pycolmap.Image(name=image_name(index), camera_id=camera)
    image.image_id = image_id(index)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame()
    frame.frame_id = image_id(index)
    frame.rig_id = camera
    frame.add_data_id(pycolmap.data_t(sensor, image_id(index)))
    database.write_frame(frame, use_frame_id=True)
