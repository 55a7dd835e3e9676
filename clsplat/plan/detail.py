"""How much fine detail the photos have, which decides how many gaussians they will ask for."""

import numpy as np

from clsplat.io.images import resample
from clsplat.train.photos import decoded

PHOTOS = 8  # that stand for all


def photo_detail(views, levels):
    """{level: mean difference in 0..1 of photos, `level` times smaller, to their blocks of 2 x 2
    pixels}: what another level of half the size would not show. Of some of the `views`, evenly
    picked; each photo is read once."""
    chosen = views[::-(-len(views) // PHOTOS)]
    found = {level: [] for level in levels}
    for view, photo in zip(chosen, decoded(chosen)):
        pixels = photo.transpose(1, 2, 0)
        for level, details in found.items():
            camera = view.camera.reduced(level)
            size = camera.width, camera.height
            small = pixels if size == pixels.shape[1::-1] else resample(pixels, size)
            details.append(_detail(small.transpose(2, 0, 1) / np.float32(255)))
    return {level: float(np.mean(details)) for level, details in found.items()}


def _detail(photo):
    height, width = (size - size % 2 for size in photo.shape[1:])
    blocks = photo[:, :height, :width].reshape(3, height // 2, 2, width // 2, 2)
    return np.abs(blocks - blocks.mean(axis=(2, 4), keepdims=True)).mean()
