"""How much darker the corners of a scene's photos are, to decide whether to learn vignetting."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.covisibility.exposure_drift import log_luma, shown_points
from clsplat.response import corner_radius, squared_radius

if TYPE_CHECKING:
    from clsplat.scene import View

# Measured at up to 256 pixels, on three divisions: caliterra 0.04, copr_dunes 0.08 to 0.09,
# boruszyn 0.18, sheffield_cross 0.04, lund 0.02, mirafiori -0.04 (docs/evidence/photos.md)
DARKENS = 0.03  # share of brightness lost in the corners from which on vignetting is learned
ROUNDS = 20  # of taking away means of photos and of points in turn


def corner_darkening(views: Sequence[View], photos: Iterable[NDArray[np.uint8]],
                     points: NDArray[np.floating]) -> float:
    """The share of brightness that photos lose in their corners; below 0 where they gain.

    The log luma of a point in a photo is taken as the sum of a number of the photo, one of the
    point, one times the log depth and one times the squared distance from the optical axis, fitted
    by least squares: the same point is seen in the middle of some photos and near the border of
    others. Where a camera moves along its axis, what is near the border is near the camera, too.

    Parameters
    ----------
    views : the views to compare.
    photos : for each view uint8[3, h, w], of any size, or uint8[4, h, w] with a mask.
    points : [N, 3], in the views' frame.

    Returns
    -------
    The darkening; 0 if no two photos show the same points.
    """
    parts = [_samples(view, photo, points) for view, photo in zip(views, photos)]
    if not parts:
        return 0.0
    view = np.repeat(np.arange(len(parts)), [len(point) for point, _ in parts])
    point = np.concatenate([point for point, _ in parts])
    columns = np.concatenate([values for _, values in parts], axis=1)
    for _ in range(ROUNDS):
        for group in (view, point):
            columns = np.stack([_without_means(group, values) for values in columns])
    luma, *known = columns
    factors = np.linalg.lstsq(np.stack(known, axis=1), luma, rcond=1e-6)[0]
    return float(1 - np.exp(factors[0]))


def _samples(view: View, photo: NDArray[np.uint8], points: NDArray[np.floating]
             ) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """The points that a photo shows, and their log luma, squared radius and log depth, [3, N].

    The squared radius is 1 in the farthest corner.
    """
    shown, column, row = shown_points(view.camera, photo, points)
    counted = np.flatnonzero((photo[3:, row, column] > 0).all(axis=0))
    shown, column, row = shown[counted], column[counted], row[counted]
    camera = view.camera.resized(photo.shape[2], photo.shape[1])
    _, depth = camera.project(points[shown])
    return shown, np.stack([log_luma(photo[:3, row, column]),
                            squared_radius(camera)[row, column] / corner_radius(camera),
                            np.log(depth)])


def _without_means(group: NDArray[np.integer], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values less the mean of their group."""
    means = np.bincount(group, values) / np.maximum(np.bincount(group), 1)
    result: NDArray[np.float64] = values - means[group]
    return result
