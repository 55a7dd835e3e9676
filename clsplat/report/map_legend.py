"""The strip below the preview of a map: a scale of lengths and one of heights."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

HEIGHT, DPI = 64, 100  # pixels, and pixels an inch
LONGEST_BAR = 0.3  # of the orthophoto's width
ROUND = 1.0, 2.0, 5.0


def map_legend(width: int, half: int, size: float, heights: tuple[float, float],
               tints: NDArray[np.float64], interval: float, unit: str, up: str
               ) -> NDArray[np.float32]:
    """A strip [HEIGHT, width, 3], 0 to 1: a bar of a round length under the orthophoto, and the
    colours of heights under the surface.

    Parameters
    ----------
    width, half : of the strip, and of the orthophoto, pixels.
    size : of a pixel, map units.
    heights : that have the first and the last of the colours, map units.
    tints : colours [N, 3], 0 to 1, from low to high.
    interval : between contour lines, map units; 0: there are none.
    unit : of the map.
    up : what is written beside the bar.
    """
    figure = Figure(figsize=(width / DPI, HEIGHT / DPI), dpi=DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    length = _round_below(LONGEST_BAR * half * size)
    axes: Any = figure.add_axes((0, 0, half / width, 1))
    axes.set(xlim=(0, half), ylim=(0, 1))
    axes.axis("off")
    begin = 0.03 * half
    axes.plot((begin, begin + length / size), (0.7, 0.7), color="black", linewidth=3,
              solid_capstyle="butt")
    axes.text(begin, 0.45, f"{length:g} {unit}" + f", {up}" * bool(up), va="top", fontsize=9)
    begin = 1 - half / width
    axes = figure.add_axes((begin + 0.04 * (1 - begin), 0.6, 0.55 * (1 - begin), 0.25))
    low, high = heights
    if high > low:
        colours = LinearSegmentedColormap.from_list("heights", tints)(np.linspace(0, 1, 256))
        axes.imshow(colours[None], aspect="auto", extent=(low, high, 0, 1))
        axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_yticks([])
    axes.tick_params(labelsize=9)
    lines = f"; a line each {interval:g}" if interval else ""
    figure.text(begin + 0.62 * (1 - begin), 0.6, f"height, {unit}{lines}", fontsize=9)
    canvas.draw()
    strip = np.asarray(canvas.buffer_rgba())[:HEIGHT, :width, :3]
    return strip.astype(np.float32) / np.float32(255)


def _round_below(length: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(factor * power for factor in ROUND if factor * power <= length * (1 + 1e-9)))
