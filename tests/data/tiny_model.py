"""A COLMAP model of a few grey photos, written by pycolmap itself."""

import contextlib

import numpy as np
import pycolmap

from clsplat.io.photos.images import write_image

WIDTH, HEIGHT = 48, 36
FOCAL, CENTRE = (50.0, 52.0), (22.5, 19.0)


def reconstruction(model="PINHOLE", parameters=(*FOCAL, *CENTRE)):
    """pycolmap.Reconstruction: four images named out of order, thirty points seen by all."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 30
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    options.camera_params = list(parameters)
    with contextlib.suppress(AttributeError):  # pycolmap before 3.13 has no seed
        pycolmap.set_random_seed(0)
    made = pycolmap.synthesize_dataset(options)
    for number, image in enumerate(made.images.values()):
        image.name = f"photo_{(number * 3) % 4}.png"
    for number, point in made.points3D.items():
        point.color = np.array([number, 2 * number, 255 - number], np.uint8)
    return made


def write_scene(folder, made=None, text=False, model="sparse/0"):
    """Write `made` (default: `reconstruction()`) and its photos into a scene folder."""
    made = made or reconstruction()
    (folder / model).mkdir(parents=True, exist_ok=True)
    (made.write_text if text else made.write_binary)(str(folder / model))
    (folder / "images").mkdir(exist_ok=True)
    for image in made.images.values():
        camera = made.cameras[image.camera_id]
        write_image(folder / "images" / image.name, np.full((camera.height, camera.width, 3), 90, np.uint8))
    return folder
