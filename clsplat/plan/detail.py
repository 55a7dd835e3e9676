"""How much fine detail the photos have, which decides how many gaussians they will ask for."""

import numpy as np

from clsplat.train.photos import at_level, decoded

PHOTOS = 8  # that stand for all


def photo_detail(views, level):
    """Mean difference in 0..1 of photos, `level` times smaller, to their blocks of 2 x 2 pixels:
    what another level of half the size would not show. Of some of the `views`, evenly picked."""
    chosen = at_level(views[::-(-len(views) // PHOTOS)], level)
    return float(np.mean([_detail(photo / np.float32(255)) for photo in decoded(chosen)]))


def _detail(photo):
    height, width = (size - size % 2 for size in photo.shape[1:])
    blocks = photo[:, :height, :width].reshape(3, height // 2, 2, width // 2, 2)
    return np.abs(blocks - blocks.mean(axis=(2, 4), keepdims=True)).mean()
