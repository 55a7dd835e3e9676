"""The views that a person should look at first: the worst, the median and the best."""

import math
from dataclasses import dataclass

import numpy as np

from clsplat.evaluate.error_map import error_map
from clsplat.evaluate.views import evaluate_views, opened_run
from clsplat.io.images import resample

LONGEST = 640  # pixels, of the longer side of a picture in a page
SAMPLED = 24  # training views that are scored where no view is held out


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


def pictures_of(renderer, rows, degree, test, train, per_view=None):
    """The Pictures of a model: of `test`, the held-out views, or of SAMPLED views of `train`, spread
    evenly, where there are none.

    per_view: the scores of `test` as `evaluate_views` lists them; None: they are made here. The
    chosen views are rendered again, so that no more than one is in memory at full size.
    """
    views = test or train[::-(-len(train) // SAMPLED)]
    if not per_view or len(per_view) != len(views):
        per_view = evaluate_views(renderer, rows, degree, views)["per_view"]
    shown = []
    for place, index in chosen_views(per_view):
        def keep(view, image, fitted, photo, place=place, scores=per_view[index]):
            pixels = (_pixels(photo), _pixels(fitted), error_map(fitted, photo))
            shown.append(ShownView(place, scores, *map(_reduced, pixels)))
        evaluate_views(renderer, rows, degree, [views[index]], keep)
    return Pictures(shown, bool(test), len(views))


def run_pictures(run, device, per_view=None):
    """`pictures_of` the finished model of a RunFolder; per_view: as `evaluate_run` returned it."""
    (renderer, rows, degree), train, test, *_ = opened_run(run, device)
    return pictures_of(renderer, rows, degree, test, train, per_view)


def _pixels(image):
    return (np.clip(np.nan_to_num(image), 0, 1) * 255 + 0.5).astype(np.uint8)


def _reduced(pixels):
    """Pixels resampled so that the longer side is at most LONGEST."""
    height, width = pixels.shape[:2]
    scale = min(1, LONGEST / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return pixels if scale == 1 else resample(pixels, size)
