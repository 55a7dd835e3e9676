"""The preview of a map: its orthophoto, and its surface shaded with contour lines."""

from collections.abc import Iterable
from typing import Any, BinaryIO

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from clsplat.report.figures import own_settings

DPI = 200  # at which letters can be read in so large a picture
SUN = 315, 45  # degrees, azimuth and elevation: from the north-west, as maps are shaded
# colours of the lowest, of the middle and of the highest ground
TINTS = LinearSegmentedColormap.from_list("heights", ["#5c8c6b", "#ded19e", "#ede8e6"])
USUAL = (0.02, 0.98)  # quantiles of the heights, which have the whole range of colours


def shaded(heights: NDArray[np.floating], size: float) -> tuple[NDArray[np.floating], float, float]:
    """Heights [H, W] in map units, nan unknown, in colours and shaded: [H, W, 3], white where they
    are unknown; and the heights of the lowest and the highest colour. `size` is that of a pixel."""
    known = np.isfinite(heights)
    low, high = np.nanquantile(heights, USUAL).tolist()
    high = max(high, low + 1e-9)
    pixels: Any = TINTS(Normalize(low, high)(np.where(known, heights, low)))[..., :3]
    if min(heights.shape) > 1:
        pixels = LightSource(*SUN).shade_rgb(pixels, np.where(known, heights, low), dx=size, dy=size, blend_mode="soft")
    return np.where(known[..., None], pixels, 1.0), low, high


def write_preview(
    file: BinaryIO,
    colours: NDArray[np.uint8],
    heights: NDArray[np.floating],
    lines: Iterable[NDArray[np.float64]],
    size: float,
    interval: float,
    unit: str,
) -> None:
    """Write a PNG with scales of length and height to a binary file.

    Parameters
    ----------
    colours : [H, W, 4], red, green, blue and alpha.
    heights : [H, W], map units; nan: unknown, white.
    lines : contour lines, (column, row) [N, 2] each; the centre of the first pixel is (0.5, 0.5).
    size : of a pixel, map units.
    interval : between contour lines, map units; 0: none.
    unit : of the map.
    """
    surface_pixels, low, high = shaded(heights, size)
    rows, columns = heights.shape
    extent = (0.0, columns * size, 0.0, rows * size)
    with own_settings():
        figure = Figure(figsize=(2.2 * columns / DPI + 2, 1.1 * rows / DPI + 1), dpi=DPI, layout="constrained")
        photo, surface = figure.subplots(1, 2, sharey=True)
        photo.imshow(colours, extent=extent)
        photo.set(xlabel=unit, ylabel=unit)
        surface.imshow(surface_pixels, extent=extent)
        surface.set(xlabel=unit)
        drawn = f"; a line each {interval:g}" if interval else ""
        figure.colorbar(
            ScalarMappable(Normalize(low, high), TINTS), ax=surface, shrink=0.6, label=f"height, {unit}{drawn}"
        )
        surface.add_collection(
            LineCollection(
                [(0.0, extent[3]) + line * (size, -size) for line in lines], colors="black", linewidths=0.4, alpha=0.6
            ),
            autolim=False,
        )
        figure.savefig(file, format="png")
