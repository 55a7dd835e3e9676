"""Small folders of photos, and reconstructions that are known."""

import numpy as np
import OpenImageIO as oiio
import pycolmap
from scipy import ndimage

from clsplat.io.photos.images import write_image
from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.sfm.photos import SourcePhoto


class Lines:
    """A progress line that keeps what it is told."""

    def __init__(self):
        self.counts, self.phases, self.messages = [], [], []

    def count(self, what, done, total):
        self.counts.append((what, done, total))

    def phase(self, text):
        self.phases.append(text)

    def message(self, text):
        self.messages.append(text)


def picture(height=48, width=64, seed=0):
    """uint8[height, width, 3] with blobs of several sizes, in which SIFT finds features."""
    rng = np.random.default_rng(seed)
    pixels = np.full((height, width, 3), 90.0)
    y, x = np.mgrid[:height, :width]
    for _ in range(height * width // 150):
        size, at = rng.uniform(1.5, 5), rng.uniform(0, 1, 2) * (height, width)
        blob = np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * size**2))
        pixels += blob[..., None] * rng.uniform(-90, 140, 3)
    return np.clip(pixels, 0, 255).astype(np.uint8)


def texture(height, width, seed=0):
    """uint8[height, width, 3], full of features, and of streaks that are too long for one."""
    values = np.random.default_rng(seed).normal(size=(height, width, 3))
    values = ndimage.gaussian_filter(values, (1.3, 2.2, 0))
    return np.clip(128 + 60 * values / values.std(), 0, 255).astype(np.uint8)


def unit_descriptors(rng, count):
    """uint8[count, 128]: RootSIFT of nothing, each as far from the others as those of photos."""
    values = rng.gamma(0.6, 1, (count, 128))
    roots = 512 * np.sqrt(values / values.sum(axis=1, keepdims=True))
    return np.minimum(roots, 255).round().astype(np.uint8)


def folder_of(path, names, size=(64, 48), exif=None):
    """Write photos of one colour with EXIF attributes."""
    for name in names:
        target = path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if exif is None:
            write_image(target, np.full((size[1], size[0], 3), 100, np.uint8))
            continue
        spec = oiio.ImageSpec(*size, 3, oiio.UINT8)
        for key, value in exif.items():
            spec.attribute(key, value)
        output = oiio.ImageOutput.create(str(target))
        assert output.open(str(target), spec)
        assert output.write_image(np.zeros((size[1], size[0], 3), np.uint8)) and output.close()
    return path


def source(name="a.jpg", width=64, height=48, **known):
    """A photo whose file is not read."""
    return SourcePhoto(name, name, PhotoMetadata(width, height, **known))


def synthetic(database=None, photos=6, points=60, distortion=0.05):
    """A pycolmap.Reconstruction of photos with ids 1 ... of one camera, and its database."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 1
    options.num_frames_per_rig, options.num_points3D = photos, points
    options.camera_width, options.camera_height = 320, 240
    options.camera_params = [400.0, 160.0, 120.0, distortion]
    if database is None:
        return pycolmap.synthesize_dataset(options)
    opened = pycolmap.Database.open(database)
    try:
        return pycolmap.synthesize_dataset(options, opened)
    finally:
        opened.close()
