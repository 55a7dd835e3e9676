"""The preview of a map: orthophoto and surface beside each other, with a scale of heights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.export.geotiff import Raster
from clsplat.export.surface import TINTS, shaded, usual_heights
from clsplat.report.map_legend import map_legend

SIDE = 1400  # pixels, the longer side of each picture


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
    legend = map_legend(pictures.shape[1], left.shape[1], size, usual_heights(heights), TINTS,
                        interval, *(("m", "north is up") if crs else ("scene units", "")))
    picture: NDArray[np.float32] = np.concatenate([pictures, legend], axis=0)
    return picture
