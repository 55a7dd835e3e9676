"""What photos of a scene disagree about, as points show it: exposure, vignetting, and colours."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.covisibility.clusters import Clusters
from clsplat.covisibility.source_views import observed_points
from clsplat.response import corner_radius, squared_radius
from clsplat.scene import Scene, View

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
# Measured at up to 256 pixels, on three divisions: caliterra 0.04, copr_dunes 0.08 to 0.09,
# boruszyn 0.18, sheffield_cross 0.04, lund 0.02, mirafiori -0.04 (docs/evidence/photos.md)
DARKENS = 0.03  # share of brightness lost in the corners from which on vignetting is learned
CORNER_ROUNDS = 20  # of taking away means of photos and of points in turn
LEAST_VIEWS = 3  # of a point; two photos agree too well, once each was fitted to their mean
LEAST_FACTOR = 0.2  # of a photo's brightness
COLOUR_ROUNDS = 3  # of fitting photos to the points' means, and taking these again


def exposure_drift(
    views: Sequence[View], photos: Iterable[NDArray[np.uint8]], points: NDArray[np.floating], colours: NDArray[np.uint8]
) -> float:
    """The standard deviation, over photos, of their log brightness relative to the sparse points.

    The brightness of a photo is the median, over the points that it shows, of log luma minus the
    log luma of the point's own colour, which is an average over photos. The part of the deviation
    that the scatter of the points explains is subtracted. The measure is not robust on purpose: a
    few photos that differ much are a reason to learn exposures, and on caliterra the only one.

    Parameters
    ----------
    views, points : the views to compare, and points [N, 3] in their frame.
    photos : for each view uint8[3, h, w], of any size, or uint8[4, h, w] with a mask.
    colours : [N, 3], of the points.

    Returns
    -------
    The drift; 0 if fewer than two photos show at least LEAST_POINTS points.
    """
    own, clusters = _log_luma(colours.T), Clusters(points)
    medians, errors = [], []
    for view, photo in zip(views, photos):
        shown, column, row = _shown_points(view.camera, photo, points, clusters)
        if len(shown) < LEAST_POINTS:
            continue
        brighter = _log_luma(photo[:3, row, column]) - own[shown]
        medians.append(np.median(brighter))
        scatter = 1.4826 * np.median(np.abs(brighter - medians[-1]))
        errors.append(1.2533 * scatter / np.sqrt(len(shown)))  # of the median of a normal sample
    if len(medians) < 2:
        return 0.0
    return float(np.sqrt(max(0, np.var(medians) - np.mean(np.square(errors)))))


def _log_luma(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Log luma [N] of pixels [3, N]."""
    return np.log(np.maximum(LUMA @ pixels / 255, DARKEST_LUMA))


def _shown_points(
    camera: Camera, photo: NDArray[np.uint8], points: NDArray[np.floating], clusters: Clusters
) -> tuple[NDArray[np.integer], NDArray[np.integer], NDArray[np.integer]]:
    """Index, pixel column and pixel row of the points in the photo that no nearer point hides, nor
    its mask. Without the test for hidden ones, walls behind roofs change the median more than
    exposure does."""
    near = np.sort(clusters.order[clusters.near_view(camera, 0.0)])
    inside, column, row, depth = _points_inside(camera, photo, points[near])
    size = -(-max(photo.shape[1:]) // OCCLUSION_CELLS)
    cell = row // size * OCCLUSION_CELLS + column // size
    nearest = np.full(OCCLUSION_CELLS**2, np.inf)
    np.minimum.at(nearest, cell, depth)
    counted = (depth <= OCCLUSION_DEPTH * nearest[cell]) & (photo[3:, row, column] > 0).all(axis=0)
    return near[inside[counted]], column[counted], row[counted]


def _points_inside(camera: Camera, photo: NDArray[np.uint8], points: NDArray[np.floating]) -> tuple[NDArray[Any], ...]:
    """Index, pixel column, pixel row and depth of the points that project into the photo."""
    _, height, width = photo.shape
    pixel, depth = camera.resized(width, height).project(points)
    inside = np.flatnonzero((depth > 0) & (pixel >= 0).all(1) & (pixel < [width, height]).all(1))
    return inside, *pixel[inside].astype(int).T, depth[inside]


def corner_darkening(views: Sequence[View], photos: Iterable[NDArray[np.uint8]], points: NDArray[np.floating]) -> float:
    """The share of brightness that photos lose in their corners; below 0 where they gain.

    The log luma of a point in a photo is taken as the sum of a number of the photo, one of the
    point, one times the log depth and one times the squared distance from the optical axis, fitted
    by least squares: the same point is seen in the middle of some photos and near the border of
    others. Where a camera moves along its axis, what is near the border is near the camera, too.
    Arguments as for `exposure_drift`; 0 if no two photos show the same points."""
    clusters = Clusters(points)
    parts = [_darkening_samples(view, photo, points, clusters) for view, photo in zip(views, photos)]
    if not parts:
        return 0.0
    view = np.repeat(np.arange(len(parts)), [len(point) for point, _ in parts])
    point = np.concatenate([point for point, _ in parts])
    columns = np.concatenate([values for _, values in parts], axis=1)
    for _ in range(CORNER_ROUNDS):
        for group in (view, point):
            columns = columns - _means(group, columns.T).T
    luma, *known = columns
    factors = np.linalg.lstsq(np.stack(known, axis=1), luma, rcond=1e-6)[0]
    return float(1 - np.exp(factors[0]))


def _darkening_samples(
    view: View, photo: NDArray[np.uint8], points: NDArray[np.floating], clusters: Clusters
) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """The points that a photo shows, and their log luma, squared radius and log depth, [3, N].

    The squared radius is 1 in the farthest corner.
    """
    shown, column, row = _shown_points(view.camera, photo, points, clusters)
    camera = view.camera.resized(photo.shape[2], photo.shape[1])
    _, depth = camera.project(points[shown])
    return shown, np.stack(
        [_log_luma(photo[:3, row, column]), squared_radius(camera)[row, column] / corner_radius(camera), np.log(depth)]
    )


def colour_disagreement(scene: Scene, views: Sequence[View], photos: Iterable[NDArray[np.uint8]]) -> float:
    """The standard deviation of a place's colour over the photos that show it.

    Each channel of a photo is first fitted to the points' mean colours by a factor and an offset,
    so that exposure and white balance are no disagreement. What is left is what no model of the
    scene explains: things that move, glare, noise, wrong poses. The deviation is that of the median
    point, so that a few wrong observations do not count. `photos` as for `exposure_drift`.

    Returns a share of full brightness; nan where no point is observed in three of the photos."""
    parts = [
        _colours(scene.points, point, view, photo)
        for view, point, photo in zip(views, observed_points(scene, views), photos)
    ]
    parts = [part for part in parts if len(part[0]) >= LEAST_POINTS]
    if not parts:
        return float("nan")
    photo_of = np.repeat(np.arange(len(parts)), [len(point) for point, _ in parts])
    point, colour = (np.concatenate(arrays) for arrays in zip(*parts))
    several = np.bincount(point)[point] >= LEAST_VIEWS
    if not several.any():
        return float("nan")
    photo_of, point, colour = photo_of[several], point[several], colour[several]
    for _ in range(COLOUR_ROUNDS):
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


def _colours(
    points: NDArray[np.floating], observed: NDArray[np.integer], view: View, photo: NDArray[np.uint8]
) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """The points of which a photo shows the colour, and these colours [M, 3]."""
    inside, column, row, _ = _points_inside(view.camera, photo, points[observed])
    counted = (photo[3:, row, column] > 0).all(axis=0)
    return observed[inside[counted]], photo[:3, row[counted], column[counted]].T / 255


def _means(group: NDArray[np.integer], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """For each row of the values [M, 3], the mean of its group's rows."""
    count = np.maximum(np.bincount(group), 1)
    return np.stack([(np.bincount(group, column) / count)[group] for column in values.T], axis=1)
