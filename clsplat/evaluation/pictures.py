"""The pictures of a report: the views with the worst, the median and the best score."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.io.photos.images import eight_bits
from clsplat.io.photos.resample import resample

MOST_PIXELS = 640  # of the longer side of a picture in a page
LARGEST_ERROR = 0.25  # of full brightness, drawn in the last colour
# matplotlib's "inferno", whose lightness grows evenly, at each tenth: from black to light yellow
COLOURS = (
    (0, 0, 4),
    (24, 12, 60),
    (66, 10, 104),
    (106, 23, 110),
    (147, 38, 103),
    (188, 55, 84),
    (221, 81, 58),
    (243, 118, 27),
    (252, 165, 10),
    (246, 215, 70),
    (252, 255, 164),
)
BETWEEN = 256  # of two of them, so many others
MASKED = 96  # of 255, grey
LEGEND = f"black: none, light yellow: {LARGEST_ERROR:.0%} of full brightness or more"


@dataclass(frozen=True)
class ShownView:
    """A view as a report shows it; images are [H, W, 3], with at most MOST_PIXELS a side.

    Attributes
    ----------
    place : "worst", "median", "best", or "only".
    scores : its part of `per_view`.
    render : after the colour fit.
    """

    place: str
    scores: dict[str, Any]
    photo: NDArray[np.uint8]
    render: NDArray[np.uint8]
    error: NDArray[np.uint8]


@dataclass(frozen=True)
class Pictures:
    """The views that a report shows, the worst first; whether they are held-out views, not training
    views; and from how many they were chosen."""

    shown: list[ShownView]
    held_out: bool
    count: int


def chosen_views(per_view: Sequence[dict[str, Any]]) -> list[tuple[str, int]]:
    """(place, index) of the worst, median and best score, by PSNR after the colour fit.

    Two views are the worst and the best; one view is the "only" one.
    """
    scores = np.array([of_view["psnr_cc"] for of_view in per_view])
    order = np.argsort(np.nan_to_num(scores, nan=-np.inf), kind="stable").tolist()
    if len(order) < 2:
        return [("only", index) for index in order]
    chosen = [("worst", order[0]), ("median", order[len(order) // 2]), ("best", order[-1])]
    return chosen if len(order) > 2 else [chosen[0], chosen[-1]]


def shown_view(
    place: str,
    scores: dict[str, Any],
    fitted: NDArray[np.floating],
    photo: NDArray[np.floating],
    valid: NDArray[np.bool_] | None = None,
) -> ShownView:
    """The ShownView of a render after the colour fit and its photo, [H, W, 3] each, 0 to 1; `valid`
    as for `error_map`."""

    def reduced(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        height, width = pixels.shape[:2]
        scale = min(1, MOST_PIXELS / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        return pixels if scale == 1 else resample(pixels, size)

    return ShownView(
        place, scores, *map(reduced, (eight_bits(photo), eight_bits(fitted), error_map(fitted, photo, valid)))
    )


def error_map(
    render: NDArray[np.floating], photo: NDArray[np.floating], valid: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """[H, W, 3], the absolute difference of images 0 to 1, mean of the channels, in COLOURS up to
    LARGEST_ERROR. A pixel that is not finite has the largest error; one that does not count, by
    `valid` bool[H, W], is grey."""
    error = np.einsum("hwc->hw", np.abs(render - photo)) / (3 * LARGEST_ERROR)
    place = np.clip(np.nan_to_num(error, nan=1.0), 0, 1) * ((len(COLOURS) - 1) * BETWEEN)
    every = np.arange((len(COLOURS) - 1) * BETWEEN + 1) / BETWEEN
    ramp = (
        np.stack([np.interp(every, range(len(COLOURS)), channel) for channel in np.transpose(COLOURS)], axis=1)
        .round()
        .astype(np.uint8)
    )
    colours: NDArray[np.uint8] = ramp[place.round().astype(np.intp)]
    if valid is not None:
        colours[~valid] = MASKED
    return colours
