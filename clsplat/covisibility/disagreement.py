"""How much photos disagree about the colours of a scene, to decide how many gaussians it gets."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.covisibility.source_views import observed_points

if TYPE_CHECKING:
    from clsplat.scene import Scene, View

LEAST_VIEWS = 3  # of a point; two photos agree too well, once each was fitted to their mean
LEAST_POINTS = 20  # a photo that shows fewer does not count
LEAST_FACTOR = 0.2  # of a photo's brightness
ROUNDS = 3  # of fitting photos to the points' means, and taking these again


def colour_disagreement(scene: Scene, views: Sequence[View], photos: Iterable[NDArray[np.uint8]]
                        ) -> float:
    """The standard deviation of a place's colour over the photos that show it.

    Each channel of a photo is first fitted to the points' mean colours by a factor and an offset,
    so that exposure and white balance are no disagreement. What is left is what no model of the
    scene explains: things that move, glare, noise, wrong poses. The deviation is that of the median
    point, so that a few wrong observations do not count.

    Parameters
    ----------
    scene : with sparse points, and the observations of them in views.
    views : of the scene, such as one part of `scene.split`.
    photos : for each view uint8[3, h, w], of any size, or uint8[4, h, w] with a mask.

    Returns
    -------
    A share of full brightness; nan where no point is observed in three of the photos.
    """
    parts = [_samples(scene.points, point, view, photo) for view, point, photo
             in zip(views, observed_points(scene, views), photos)]
    parts = [part for part in parts if len(part[0]) >= LEAST_POINTS]
    if not parts:
        return float("nan")
    photo_of = np.repeat(np.arange(len(parts)), [len(point) for point, _ in parts])
    point, colour = (np.concatenate(arrays) for arrays in zip(*parts))
    several = np.bincount(point)[point] >= LEAST_VIEWS
    if not several.any():
        return float("nan")
    photo_of, point, colour = photo_of[several], point[several], colour[several]
    for _ in range(ROUNDS):
        mean = _means(point, colour)
        for rows in (np.flatnonzero(photo_of == number) for number in np.unique(photo_of)):
            for channel in range(3):  # the means have less noise, so they are the known side
                known = np.stack([mean[rows, channel], np.ones(len(rows))], axis=1)
                factor, offset = np.linalg.lstsq(known, colour[rows, channel], rcond=1e-6)[0]
                colour[rows, channel] -= offset
                colour[rows, channel] /= max(factor, LEAST_FACTOR)
    count = np.bincount(point)[point]
    deviation = np.abs(colour - _means(point, colour)) * np.sqrt(count / (count - 1))[:, None]
    return 1.4826 * float(np.median(deviation))  # of a normal distribution


def _samples(points: NDArray[np.floating], observed: NDArray[np.integer], view: View,
             photo: NDArray[np.uint8]) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """The points of which a photo shows the colour, and these colours [M, 3]."""
    _, height, width = photo.shape
    pixel, depth = view.camera.resized(width, height).project(points[observed])
    column, row = np.floor(pixel).astype(int).T
    inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    observed, column, row = observed[inside], column[inside], row[inside]
    counted = (photo[3:, row, column] > 0).all(axis=0)
    return observed[counted], photo[:3, row[counted], column[counted]].T / 255


def _means(group: NDArray[np.integer], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """For each row of the values [M, 3], the mean of its group's rows."""
    count = np.maximum(np.bincount(group), 1)
    return np.stack([(np.bincount(group, column) / count)[group] for column in values.T], axis=1)
