"""How much fine detail the photos have, on which the number of gaussians depends."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.io.photos.resample import resample
from clsplat.scene import View
from clsplat.training.photos import decoded

SAMPLED_PHOTOS = 8
SAMPLED_PIXELS, BANDS = 2e6, 16  # of a large photo


def photo_detail(views: Sequence[View], levels: Iterable[float]) -> dict[float, float]:
    """Measure the detail that photos at each level would lose at half the size.

    It is the mean difference, in 0..1, between a photo `level` times smaller and the means of its
    blocks of 2 x 2 pixels. Some evenly spaced views are sampled; each photo is read once.
    """
    chosen = views[::-(-len(views) // SAMPLED_PHOTOS)]
    sampled: dict[float, list[np.floating]] = {level: [] for level in levels}
    for photo in decoded(chosen):
        for part in _parts(photo[:3].transpose(1, 2, 0)):
            for level, details in sampled.items():
                height, width = (max(1, int(side / level)) for side in part.shape[:2])
                small = part if level == 1 else resample(part, (width, height))
                details.append(_detail(small.transpose(2, 0, 1) / np.float32(255)))
    return {level: float(np.mean(details)) for level, details in sampled.items()}


def _parts(pixels: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """A photo [H, W, 3], or evenly spaced bands of rows with SAMPLED_PIXELS together."""
    height, width = pixels.shape[:2]
    if height * width <= SAMPLED_PIXELS:
        return [pixels]
    rows = int(SAMPLED_PIXELS / BANDS / width)
    return [pixels[top:top + rows] for top in
            np.linspace(0, height - rows, BANDS).astype(int)]


def _detail(photo: NDArray[np.floating]) -> np.floating:
    height, width = (size - size % 2 for size in photo.shape[1:])
    blocks = photo[:, :height, :width].reshape(3, height // 2, 2, width // 2, 2)
    lost: np.floating = np.abs(blocks - blocks.mean(axis=(2, 4), keepdims=True)).mean()
    return lost
