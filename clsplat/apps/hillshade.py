"""The shading of a surface by a low sun, as maps have it."""

import math

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.apps.geotiff import Raster
from clsplat.apps.terrain import nearest
from clsplat.report.figures.map_preview import SUN

NODATA = 0  # as of gdaldem: what is known is 1, in full shadow, to 255
TAGS = {"HILLSHADE_AZIMUTH": f"{SUN[0]} degrees", "HILLSHADE_ALTITUDE": f"{SUN[1]} degrees"}


def write_hillshade(surface: Raster, shade: Raster) -> None:
    """Write the shading of a surface.

    Parameters
    ----------
    surface : finished; its first band is heights.
    shade : of the same grid, with one band and NODATA; where the surface is unknown, so is it.
    """
    for y, x in np.ndindex(surface.grid.tiles[::-1]):
        heights = surface.read((x, y), 1)[..., 0]
        if np.isfinite(heights[1:-1, 1:-1]).any():
            shade.write((x, y), hillshade(heights, surface.grid.resolution)[1:-1, 1:-1, None])


def hillshade(heights: NDArray[np.floating], resolution: float) -> NDArray[np.uint8]:
    """The light on each pixel, [H, W]: 1 and the cosine between its normal and the SUN times 254,
    NODATA where the height is unknown.

    Slopes are those of Horn 1981, as in gdaldem. matplotlib's LightSource stretches the contrast of
    each tile apart, which leaves borders between them.

    Parameters
    ----------
    heights : [H, W], map units; nan: unknown.
    resolution : map units a pixel.
    """
    known = np.isfinite(heights)
    level = nearest(heights.astype(np.float64), known)
    east, south = (scipy.ndimage.sobel(level, axis, mode="nearest") / (8 * resolution) for axis in (1, 0))
    azimuth, altitude = np.radians(SUN)
    towards = -east * math.sin(azimuth) + south * math.cos(azimuth)
    light = (math.sin(altitude) + math.cos(altitude) * towards) / np.sqrt(1 + east**2 + south**2)
    return np.where(known, 1 + 254 * np.clip(light, 0, 1) + 0.5, NODATA).astype(np.uint8)
