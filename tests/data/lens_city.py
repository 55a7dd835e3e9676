"""The sample city as a survey delivers it: photos of a lens with distortion, of which some have
masks and some have depth maps."""

import numpy as np
import pycolmap
from scipy.ndimage import map_coordinates

from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_training import CITY
from tools.synth.city import lay_out
from tools.synth.raycast import cast

REDUCED = 2  # the photos' size, from that of the sample
ZOOM = 1.2  # of the focal length: a lens with a barrel distortion sees more
DISTORTION = (-0.1, 0.02, 0.002, -0.003)
MASKED_EVERY = 3
DEPTH_STEP = 4  # pixels of the photo to a depth


def write_lens_city(folder, with_depth):
    """Write the scene; with_depth: called with a pinhole view, says whether it has a depth map.

    What is under masks is noise. Depths are along the camera's axis.
    """
    scene, city = read_scene(CITY).reduced(REDUCED), lay_out((2, 2), 0)
    camera = scene.views[0].camera
    made = pycolmap.Reconstruction(str(CITY / "sparse/0"))
    values = (*(ZOOM * np.array(camera.focal)), *camera.centre, *DISTORTION)
    for known in made.cameras.values():
        known.model, known.params = pycolmap.CameraModelId.OPENCV, values
        known.width, known.height = camera.width, camera.height
    for name in ("sparse/0", "images", "masks", "depth"):
        (folder / name).mkdir(parents=True)
    made.write_binary(str(folder / "sparse/0"))
    lens = pycolmap.Camera(model="OPENCV", width=camera.width, height=camera.height, params=values)
    random = np.random.default_rng(0)
    for number, view in enumerate(scene.views):
        pixels, (x, y) = read_photo(view), _pinhole_pixels(lens, view.camera)
        photo = np.stack(
            [
                map_coordinates(plane, (y - 0.5, x - 0.5), order=1, mode="nearest")
                for plane in pixels.transpose(2, 0, 1)
            ],
            axis=2,
        )
        if number % MASKED_EVERY == 0:
            valid = np.ones(photo.shape, bool)
            valid[30:70, 40:100] = False
            photo = np.where(valid, photo, random.integers(0, 256, photo.shape, np.uint8))
            write_image(folder / f"masks/{view.name}.png", valid * np.uint8(255))
        write_image(folder / "images" / view.name, photo, 98)
        if with_depth(view):
            some = slice(DEPTH_STEP // 2, None, DEPTH_STEP)
            places = np.stack([x[some, some].ravel(), y[some, some].ravel()], axis=1)
            points, _ = cast(city, view.camera.shifted(-scene.offset), places)
            depth = view.camera.project(points - scene.offset)[1]
            np.save(folder / f"depth/{view.name}.npy", depth.reshape(x[some, some].shape))
    return folder


def _pinhole_pixels(lens, camera):
    """x and y [H, W] in a pinhole camera's image of the pixels of a lens."""
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = np.asarray(lens.cam_from_img(np.stack([columns.ravel(), rows.ravel()], axis=1)))
    x, y = (rays * camera.focal + camera.centre).T
    return x.reshape(columns.shape), y.reshape(columns.shape)
