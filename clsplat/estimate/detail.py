"""How much fine detail the photos have, which decides how many gaussians they will ask for."""

import numpy as np

from clsplat.io.resample import resample
from clsplat.training.photos import decoded

PHOTOS = 8  # that stand for all
MOST_PIXELS, BANDS = 2e6, 16  # of a photo that are looked at


def photo_detail(views, levels):
    """{level: mean difference in 0..1 of photos, `level` times smaller, to their blocks of 2 x 2
    pixels}: what another level of half the size would not show. Of some of the `views`, evenly
    picked; each photo is read once."""
    chosen = views[::-(-len(views) // PHOTOS)]
    found = {level: [] for level in levels}
    for photo in decoded(chosen):
        for part in _parts(photo.transpose(1, 2, 0)):
            for level, details in found.items():
                height, width = (max(1, int(side / level)) for side in part.shape[:2])
                small = part if level == 1 else resample(part, (width, height))
                details.append(_detail(small.transpose(2, 0, 1) / np.float32(255)))
    return {level: float(np.mean(details)) for level, details in found.items()}


def _parts(pixels):
    """A photo uint8[H, W, 3], or of one of more than MOST_PIXELS some bands of rows, evenly spread,
    that have so many together."""
    height, width = pixels.shape[:2]
    if height * width <= MOST_PIXELS:
        return [pixels]
    rows = int(MOST_PIXELS / BANDS / width)
    return [pixels[top:top + rows] for top in
            np.linspace(0, height - rows, BANDS).astype(int)]


def _detail(photo):
    height, width = (size - size % 2 for size in photo.shape[1:])
    blocks = photo[:, :height, :width].reshape(3, height // 2, 2, width // 2, 2)
    return np.abs(blocks - blocks.mean(axis=(2, 4), keepdims=True)).mean()
