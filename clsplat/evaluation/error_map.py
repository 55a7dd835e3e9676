"""The difference between a render and its photo, as a picture."""

import numpy as np
from numpy.typing import NDArray

LARGEST_ERROR = 0.25  # of full brightness, drawn in the last colour
# matplotlib's "inferno", whose lightness grows evenly, at each tenth: from black to light yellow
COLOURS = ((0, 0, 4), (24, 12, 60), (66, 10, 104), (106, 23, 110), (147, 38, 103), (188, 55, 84),
           (221, 81, 58), (243, 118, 27), (252, 165, 10), (246, 215, 70), (252, 255, 164))
MASKED = 96  # of 255, grey
LEGEND = f"black: none, light yellow: {LARGEST_ERROR:.0%} of full brightness or more"


def error_map(render: NDArray[np.floating], photo: NDArray[np.floating],
              valid: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """The absolute difference of each pixel, mean of its channels, in COLOURS up to LARGEST_ERROR.

    A pixel that is not finite has the largest error; one that does not count is grey.

    Parameters
    ----------
    render, photo : [H, W, 3], 0 to 1.
    valid : bool[H, W], the pixels that count; None: all.

    Returns
    -------
    [H, W, 3].
    """
    error = np.abs(render - photo).mean(axis=2) / LARGEST_ERROR
    place = np.clip(np.nan_to_num(error, nan=1.0), 0, 1) * (len(COLOURS) - 1)
    colours = np.stack([np.interp(place, np.arange(len(COLOURS)), channel)
                        for channel in np.transpose(COLOURS)], axis=2).round().astype(np.uint8)
    if valid is not None:
        colours[~valid] = MASKED
    return colours
