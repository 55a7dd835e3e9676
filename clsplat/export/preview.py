"""The preview of a map: orthophoto and surface beside each other, with a scale of heights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from clsplat.export.geotiff import Raster
from clsplat.export.surface import TINTS, shaded, usual_heights

SIDE = 1400  # pixels, the longer side of each picture
LEGEND = 64  # pixels, the height of the strip below them
DPI = 100
LONGEST_BAR = 0.3  # of the picture's width
ROUND = (1.0, 2.0, 5.0)


def preview(colours: Raster, surface: Raster, interval: float, crs: str | None
            ) -> NDArray[np.float32]:
    """A picture float32[H, W, 3], 0 to 1: orthophoto and shaded surface with contour lines on
    white, with a scale of lengths and one of heights below.

    Parameters
    ----------
    colours, surface : rasters of the map.
    interval : between contour lines, map units; 0: none.
    crs : of the map; None: lengths are scene units.
    """
    level = surface.level(SIDE)
    pixels = colours.whole(level).astype(np.float32) / 255
    left = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    heights = surface.whole(level)[..., 0]
    size = surface.grid.resolution * 2**level
    gap = np.ones((len(left), max(4, left.shape[1] // 50), 3), np.float32)
    pictures = np.concatenate([left, gap, shaded(heights, size, interval)], axis=1)
    legend = _legend(pictures.shape[1], left.shape[1], size, usual_heights(heights), interval,
                     "m" if crs else "scene units")
    picture: NDArray[np.float32] = np.concatenate([pictures, legend], axis=0)
    return picture


def _legend(width: int, half: int, size: float, heights: Sequence[float], interval: float,
            unit: str) -> NDArray[np.float32]:
    """A strip [LEGEND, width, 3]: a bar of a round length under the orthophoto, `half` pixels wide,
    and the colours of heights under the surface."""
    figure = Figure(figsize=(width / DPI, LEGEND / DPI), dpi=DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    length = _round_below(LONGEST_BAR * half * size)
    axes: Any = figure.add_axes((0, 0, half / width, 1))
    axes.set(xlim=(0, half), ylim=(0, 1))
    axes.axis("off")
    begin = 0.03 * half
    axes.plot((begin, begin + length / size), (0.7, 0.7), color="black", linewidth=3,
              solid_capstyle="butt")
    axes.text(begin, 0.45, f"{length:g} {unit}, north is up", va="top", fontsize=9)
    begin = 1 - half / width
    axes = figure.add_axes((begin + 0.04 * (1 - begin), 0.6, 0.55 * (1 - begin), 0.25))
    low, high = heights
    if high > low:
        colours = LinearSegmentedColormap.from_list("heights", TINTS)(np.linspace(0, 1, 256))
        axes.imshow(colours[None], aspect="auto", extent=(low, high, 0, 1))
        axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_yticks([])
    axes.tick_params(labelsize=9)
    lines = f"; a line each {interval:g}" if interval else ""
    figure.text(begin + 0.62 * (1 - begin), 0.6, f"height, {unit}{lines}", fontsize=9)
    canvas.draw()
    strip = np.asarray(canvas.buffer_rgba())[:LEGEND, :width, :3]
    return strip.astype(np.float32) / np.float32(255)


def _round_below(length: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(factor * power for factor in ROUND if factor * power <= length * (1 + 1e-9)))
