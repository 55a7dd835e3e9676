"""How true the surface of a map is: against the solids of a city that `clsplat synth` made.

    clsplat synth --blocks 2x2 --views 48 --size 320x240 -o CITY
    clsplat train CITY -n 1500 -o RUN
    clsplat map RUN -o MAP
    python -m tools.studies.surface MAP [--city CITY/geometry.json]

Prints the share of known pixels that lie far below the median of their surroundings, and, with the
true geometry, how much of the built area has a height, and the error of the heights there.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import rasterio

from clsplat.synth.geometry import load

WINDOW, STEP, SAMPLE = 101, 4, 5  # pixels: of the median, between its places, between its samples
FAR = 2.0  # map units: far below, or wrong


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", type=Path)
    parser.add_argument("--city", type=Path)
    chosen = parser.parse_args()
    with rasterio.open(chosen.map / "surface.tif") as file:
        heights, bounds, size = file.read(1).astype(float), file.bounds, file.res[0]
    known = np.isfinite(heights)
    below = (heights - local_median(heights))[known]
    print(f"{known.sum():,} known pixels, {(below < -FAR).mean():.4%} more than {FAR:g} below the "
          f"median of {WINDOW} x {WINDOW} pixels, {(below < -50).mean():.4%} more than 50")
    if chosen.city:
        city = load(chosen.city)
        x = bounds.left + (np.arange(heights.shape[1]) + 0.5) * size
        y = bounds.top - (np.arange(heights.shape[0]) + 0.5) * size
        built = (abs(y)[:, None] < city.extent[1]) & (abs(x) < city.extent[0])
        error = (heights - true_heights(city, *np.meshgrid(x, y)))[known & built]
        print(f"built area: {(known & built).sum() / built.sum():.1%} covered, error "
              f"{np.median(abs(error)):.3f} (median), {np.quantile(abs(error), 0.95):.3f} (95 %); "
              f"{(error < -FAR).mean():.2%} more than {FAR:g} too low, {(error > FAR).mean():.2%} "
              "too high")


def local_median(heights):
    """[H, W]: the median of the known heights around each pixel, in steps."""
    reach = WINDOW // 2
    padded = np.pad(heights, reach, constant_values=np.nan)
    rows = []
    with warnings.catch_warnings():  # of windows in which nothing is known
        warnings.simplefilter("ignore", RuntimeWarning)
        for row in range(0, heights.shape[0], STEP):
            windows = np.lib.stride_tricks.sliding_window_view(
                padded[row:row + WINDOW:SAMPLE], WINDOW, axis=1)[:, ::STEP, ::SAMPLE]
            rows.append(np.nanmedian(windows, axis=(0, 2)))
    return np.kron(rows, np.ones((STEP, STEP)))[:heights.shape[0], :heights.shape[1]]


def true_heights(city, x, y):
    """The height of the highest solid at places."""
    top = np.zeros(x.shape)
    for (left, front, _), (right, back, height) in city.boxes:
        at = (x >= left) & (x <= right) & (y >= front) & (y <= back)
        top[at] = np.maximum(top[at], height)
    for *centre, height, radius in city.spheres:
        room = radius**2 - (x - centre[0])**2 - (y - centre[1])**2
        at = room >= 0
        top[at] = np.maximum(top[at], height + np.sqrt(room[at]))
    return top


if __name__ == "__main__":
    main()
