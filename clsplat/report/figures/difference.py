"""The picture of what changed between two surveys of one place."""

from typing import Any, BinaryIO

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from clsplat.report.figures import own_settings
from clsplat.report.figures.map_preview import DPI, SUN

CHANGES = "RdBu"  # red: gone; blue: grown
STRONGEST = 0.98  # quantile of the changes that has the full colour
MOST_SIDE = 1400  # pixels of the picture


def strongest(change: NDArray[np.floating], level: float) -> float:
    """The change of height that has the full colour; arguments are those of `write_difference`."""
    changes = np.abs(change[np.isfinite(change)])
    return max(float(np.quantile(changes, STRONGEST)) if len(changes) else level, 1e-9)


def write_difference(
    file: BinaryIO, heights: NDArray[np.floating], change: NDArray[np.floating], pixel: float, level: float, unit: str
) -> None:
    """Write a PNG of changes over the shaded surface, with a scale, to a binary file.

    Parameters
    ----------
    heights : [H, W], of the earlier survey, map units; nan: unknown, white.
    change : [H, W], later minus earlier; nan: none that is beyond the noise.
    pixel : the side of a pixel, map units.
    level : of detection, map units.
    unit : of the map.
    """
    step = max(1, -(-max(heights.shape) // MOST_SIDE))
    heights, change = heights[::step, ::step], change[::step, ::step]
    known, size = np.isfinite(heights), pixel * step
    low = float(np.min(heights[known]))
    shade: Any = np.ones(heights.shape)
    if min(heights.shape) > 1:
        shade = 0.45 + 0.5 * LightSource(*SUN).hillshade(np.where(known, heights, low), dx=size, dy=size)
    most = strongest(change, level)
    norm = Normalize(-most, most)
    rows, columns = heights.shape
    extent = (0.0, columns * size, 0.0, rows * size)
    with own_settings():
        figure = Figure(figsize=(1.1 * columns / DPI + 2, 1.1 * rows / DPI + 1), dpi=DPI, layout="constrained")
        axes = figure.subplots()
        axes.imshow(np.where(known, shade, 1.0), extent=extent, cmap="gray", vmin=0, vmax=1)
        axes.imshow(np.ma.masked_invalid(change), extent=extent, cmap=CHANGES, norm=norm)
        axes.set(xlabel=unit, ylabel=unit)
        figure.colorbar(
            ScalarMappable(norm, CHANGES),
            ax=axes,
            shrink=0.7,
            label=f"change of height, {unit}; shown where it is beyond the noise, {level:.2g} on the ground",
        )
        figure.savefig(file, format="png")
