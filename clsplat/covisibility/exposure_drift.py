"""How much the exposure of a scene's photos drifts, to decide whether to learn exposures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.scene import View

# Drift from which on exposures are learned. Measured at a half to an eighth of the photos' size:
# 0.002 to 0.010 for the synthetic city, which has no drift, and 0.008 to 0.067 with a twentieth of
# its points; where automatic exposure is clearly visible, caliterra 0.069 to 0.084, lund 0.091 to
# 0.111, boruszyn 0.110 to 0.114 (with matched points only, along the tracks: city 0.003; 0.106,
# 0.099, 0.113).
DRIFTS = 0.045

LEAST_POINTS = 20  # a photo that shows fewer does not count
LUMA = np.array([0.299, 0.587, 0.114])  # Rec. 601
DARKEST_LUMA = 8 / 255  # darker pixels are noise
OCCLUSION_CELLS = 32  # across a photo, for the occlusion test
OCCLUSION_DEPTH = 1.1  # times the depth of the nearest point in its cell: farther points are hidden


def exposure_drift(views: Sequence[View], photos: Iterable[NDArray[np.uint8]],
                   points: NDArray[np.floating], colours: NDArray[np.uint8]) -> float:
    """The standard deviation, over photos, of their log brightness relative to the sparse points.

    The brightness of a photo is the median, over the points that it shows, of log luma minus the
    log luma of the point's own colour, which is an average over photos. The part of the deviation
    that the scatter of the points explains is subtracted. The measure is not robust on purpose: a
    few photos that differ much are a reason to learn exposures, and on caliterra the only one.

    Parameters
    ----------
    views : the views to compare.
    photos : for each view uint8[3, h, w], of any size, or uint8[4, h, w] with a mask.
    points : [N, 3], in the views' frame.
    colours : [N, 3], of the points.

    Returns
    -------
    The drift; 0 if fewer than two photos show at least LEAST_POINTS points.
    """
    own = log_luma(colours.T)
    medians, errors = [], []
    for view, photo in zip(views, photos):
        shown, column, row = shown_points(view.camera, photo, points)
        counted = np.flatnonzero((photo[3:, row, column] > 0).all(axis=0))
        shown, column, row = shown[counted], column[counted], row[counted]
        if len(shown) < LEAST_POINTS:
            continue
        brighter = log_luma(photo[:3, row, column]) - own[shown]
        medians.append(np.median(brighter))
        scatter = 1.4826 * np.median(np.abs(brighter - medians[-1]))
        errors.append(1.2533 * scatter / np.sqrt(len(shown)))  # of the median of a normal sample
    if len(medians) < 2:
        return 0.0
    return float(np.sqrt(max(0, np.var(medians) - np.mean(np.square(errors)))))


def log_luma(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Log luma [N] of pixels [3, N]."""
    return np.log(np.maximum(LUMA @ pixels / 255, DARKEST_LUMA))


def shown_points(camera: Camera, photo: NDArray[np.uint8], points: NDArray[np.floating]
           ) -> tuple[NDArray[np.integer], NDArray[np.integer], NDArray[np.integer]]:
    """Index, pixel column and pixel row of the points in the photo that no nearer point hides.

    Without the occlusion test, walls behind roofs change the median more than exposure does.
    """
    _, height, width = photo.shape
    pixel, depth = camera.resized(width, height).project(points)
    inside = np.flatnonzero((depth > 0) & (pixel >= 0).all(1) & (pixel < [width, height]).all(1))
    column, row = pixel[inside].astype(int).T
    size = -(-max(width, height) // OCCLUSION_CELLS)
    cell = row // size * OCCLUSION_CELLS + column // size
    nearest = np.full(OCCLUSION_CELLS**2, np.inf)
    np.minimum.at(nearest, cell, depth[inside])
    front = depth[inside] <= OCCLUSION_DEPTH * nearest[cell]
    return inside[front], column[front], row[front]
