"""The views that a person should look at first: the worst, the median and the best."""

import math
from dataclasses import dataclass

import numpy as np

from clsplat.evaluation.error_map import error_map
from clsplat.io.resample import resample

LONGEST = 640  # pixels, of the longer side of a picture in a page


@dataclass(frozen=True)
class ShownView:
    """A view as it is shown: place: "worst", "median", "best"; scores: its part of `per_view`;
    photo, render (after the colour fit), error: uint8[H, W, 3], not larger than LONGEST."""

    place: str
    scores: dict
    photo: np.ndarray
    render: np.ndarray
    error: np.ndarray


@dataclass(frozen=True)
class Pictures:
    """shown: ShownViews, worst first; held_out: whether they are, or were trained on; count: of the
    views that they were chosen from."""

    shown: list
    held_out: bool
    count: int


def chosen_views(per_view):
    """[(place, index)] of the worst, median and best of the scores that `evaluate_views` lists, by
    PSNR after the colour fit; of two the worst and best, of one "only"."""
    def score(index):
        psnr = per_view[index]["psnr_cc"]
        return -math.inf if math.isnan(psnr) else psnr

    order = sorted(range(len(per_view)), key=score)
    if len(order) < 2:
        return [("only", index) for index in order]
    chosen = [("worst", order[0]), ("median", order[len(order) // 2]), ("best", order[-1])]
    return chosen if len(order) > 2 else [chosen[0], chosen[-1]]


def shown_view(place, scores, fitted, photo):
    """The ShownView of a render after the colour fit and its photo, float[H, W, 3] each."""
    pixels = (_pixels(photo), _pixels(fitted), error_map(fitted, photo))
    return ShownView(place, scores, *map(_reduced, pixels))


def _pixels(image):
    return (np.clip(np.nan_to_num(image), 0, 1) * 255 + 0.5).astype(np.uint8)


def _reduced(pixels):
    """Pixels resampled so that the longer side is at most LONGEST."""
    height, width = pixels.shape[:2]
    scale = min(1, LONGEST / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return pixels if scale == 1 else resample(pixels, size)
