"""How much the brightness of a scene's photos drifts: whether learning exposures is worth it."""

import numpy as np

# From here on photos count as drifting. Measured at a half to an eighth of the size: the synthetic
# city, which has no drift, 0.002 to 0.010, and 0.008 to 0.067 with a twentieth of its points; where
# automatic exposure is plain to see, caliterra 0.069 to 0.084, lund 0.091 to 0.111, boruszyn 0.110
# to 0.114 (along the tracks, of matched points only: city 0.003; 0.106, 0.099, 0.113).
DRIFTS = 0.045

FEWEST = 20  # points that say something about a photo
LUMA = np.array([0.299, 0.587, 0.114])  # Rec. 601
FLOOR = 8 / 255  # what is darker is noise
CELLS = 32  # across a photo, for finding what hides behind what
DEEPER = 1.1  # than the nearest point of its cell: counts as hidden


def exposure_drift(views, photos, points, colours):
    """The standard deviation over photos of their log brightness against the sparse points'.

    views: Views; photos: an iterable of uint8[3, h, w], one a view, of any size; points:
    float[N, 3], world; colours: uint8[N, 3]. A photo's brightness is the median of log luma at the
    points it shows, less the points' own, which are averages over photos. What the scatter of the
    points adds by itself is taken off. Not a robust spread: a few photos that are far off are a
    reason to learn exposures, and on caliterra all there is. Photos with less than FEWEST points do
    not count; with less than two left, 0.
    """
    own = _log_luma(colours.T)
    medians, errors = [], []
    for view, photo in zip(views, photos):
        shown, column, line = _shown(view.camera, photo, points)
        if len(shown) < FEWEST:
            continue
        brighter = _log_luma(photo[:, line, column]) - own[shown]
        medians.append(np.median(brighter))
        scatter = 1.4826 * np.median(np.abs(brighter - medians[-1]))
        errors.append(1.2533 * scatter / np.sqrt(len(shown)))  # of the median of a normal sample
    if len(medians) < 2:
        return 0.0
    return float(np.sqrt(max(0, np.var(medians) - np.mean(np.square(errors)))))


def _log_luma(pixels):
    """float64[N] of uint8[3, N]."""
    return np.log(np.maximum(LUMA @ pixels / 255, FLOOR))


def _shown(camera, photo, points):
    """(indices, columns, lines) of the points inside the photo that no nearer point seems to hide.

    Without this, walls seen through roofs move the median by more than exposure does.
    """
    _, height, width = photo.shape
    pixel, depth = camera.resized(width, height).project(points)
    inside = np.flatnonzero((depth > 0) & (pixel >= 0).all(1) & (pixel < [width, height]).all(1))
    column, line = pixel[inside].astype(int).T
    size = -(-max(width, height) // CELLS)
    cell = line // size * CELLS + column // size
    nearest = np.full(CELLS * CELLS, np.inf)
    np.minimum.at(nearest, cell, depth[inside])
    front = depth[inside] <= DEEPER * nearest[cell]
    return inside[front], column[front], line[front]
