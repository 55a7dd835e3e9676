"""SIFT features in float64 (cl/sift.cl has the method)."""

import numpy as np

LEVELS, SCALES, SIGMA = 6, 3, 1.6
CONTRAST, EDGE = 0.02 / 3, 10
SAMPLES, CELL = 20, 4


def smoothed(image, sigma):
    """A Gaussian of four sigma on each side; beyond the border, that of the border."""
    radius = int(np.ceil(4 * sigma))
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    taps /= taps.sum()
    for axis in (0, 1):
        padded = np.pad(image, [(radius, radius) if axis == each else (0, 0) for each in (0, 1)], "edge")
        image = sum(
            tap * np.take(padded, range(start, start + image.shape[axis]), axis) for start, tap in enumerate(taps)
        )
    return image


def grey(pixels, width, height):
    """The luminance of uint8[h, w, 3], 0 to 1, bilinear at another size."""
    values = pixels @ [0.299, 0.587, 0.114] / 255
    for axis, size in enumerate((height, width)):
        most = values.shape[axis] - 1
        at = np.clip((np.arange(size) + 0.5) * (most + 1) / size - 0.5, 0, most)
        low = np.minimum(at.astype(int), most)
        share = (at - low).reshape([-1, 1] if axis == 0 else [1, -1])
        values = (1 - share) * np.take(values, low, axis) + share * np.take(values, np.minimum(low + 1, most), axis)
    return values


def scale_space(pixels, width, height):
    """The levels [6, h, w] of each octave, down to eight pixels and at most four."""
    image = smoothed(grey(pixels, width, height), np.sqrt(SIGMA**2 - 0.5**2))
    octaves = []
    while len(octaves) < 4 and min(image.shape) >= 8:
        levels = [image]
        for level in range(LEVELS - 1):
            levels.append(smoothed(levels[-1], SIGMA * 2 ** (level / SCALES) * np.sqrt(2 ** (2 / SCALES) - 1)))
        octaves.append(np.array(levels))
        image = levels[SCALES][::2, ::2]
    return octaves


def keypoints(octaves):
    """x, y, level, octave [N, 4] of the refined extrema, and where each was found [N, 4]."""
    rows, found = [], {}
    for octave, levels in enumerate(octaves):
        d = np.diff(levels, axis=0)
        for level in range(1, SCALES + 1):
            for y in range(1, d.shape[1] - 1):
                for x in range(1, d.shape[2] - 1):
                    value = d[level, y, x]
                    if abs(value) <= 0.8 * CONTRAST:
                        continue
                    others = np.delete(d[level - 1 : level + 2, y - 1 : y + 2, x - 1 : x + 2], 13)
                    if value > others.max() or value < others.min():
                        refined = refine(d, level, y, x)
                        if refined:
                            place, row = refined
                            found[(octave, *place)] = (*row, octave)
    rows = sorted(found)
    return np.array([found[row] for row in rows]).reshape(-1, 4), np.array(rows).reshape(-1, 4)


def refine(d, level, y, x):
    """((level, y, x), (x, y, level)) of an extremum, or None."""
    for move in range(5):
        cube = d[level - 1 : level + 2, y - 1 : y + 2, x - 1 : x + 2]
        gradient = (
            np.array([cube[1, 1, 2] - cube[1, 1, 0], cube[1, 2, 1] - cube[1, 0, 1], cube[2, 1, 1] - cube[0, 1, 1]]) / 2
        )
        middle = 2 * cube[1, 1, 1]
        xx = cube[1, 1, 2] + cube[1, 1, 0] - middle
        yy = cube[1, 2, 1] + cube[1, 0, 1] - middle
        ss = cube[2, 1, 1] + cube[0, 1, 1] - middle
        xy = (cube[1, 2, 2] - cube[1, 2, 0] - cube[1, 0, 2] + cube[1, 0, 0]) / 4
        xs = (cube[2, 1, 2] - cube[2, 1, 0] - cube[0, 1, 2] + cube[0, 1, 0]) / 4
        ys = (cube[2, 2, 1] - cube[2, 0, 1] - cube[0, 2, 1] + cube[0, 0, 1]) / 4
        hessian = np.array([[xx, xy, xs], [xy, yy, ys], [xs, ys, ss]])
        if np.linalg.det(hessian) == 0:
            return None
        shift = -np.linalg.solve(hessian, gradient)
        steps = [
            int(move > 0.6 and at < size - 2) - int(move < -0.6 and at > 1)
            for move, at, size in zip(shift, (x, y), (d.shape[2], d.shape[1]))
        ]
        if any(steps) and move < 4:
            x, y = x + steps[0], y + steps[1]
            continue
        value, curvature = cube[1, 1, 1] + gradient @ shift / 2, xx * yy - xy * xy
        row = np.array([x, y, level]) + shift
        if (
            abs(value) < CONTRAST
            or curvature <= 0
            or (xx + yy) ** 2 >= (EDGE + 1) ** 2 / EDGE * curvature
            or np.abs(shift).max() >= 1.5
            or (row < 0).any()
            or (row > np.array(d.shape)[[2, 1, 0]] - [1, 1, 0]).any()
        ):
            return None
        return (level, y, x), row
    return None


def sampled(image, x, y):
    """Bilinear; beyond the border, that of the border."""
    height, width = image.shape
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    fx, fy = x - left, y - top
    return (1 - fy) * ((1 - fx) * image[top, left] + fx * image[top, left + 1]) + fy * (
        (1 - fx) * image[top + 1, left] + fx * image[top + 1, left + 1]
    )


def gradients(octaves, keypoint, spacing, angle, sigma, bins):
    """Weighted lengths and directions, 0 to `bins`, of a turned grid [20, 20]."""
    x, y, level, octave = keypoint
    image = octaves[int(octave)][min(max(int(level + 0.5), 0), LEVELS - 1)]
    away = (np.arange(SAMPLES + 2) - 1 - (SAMPLES - 1) / 2) * spacing * SIGMA * 2 ** (level / SCALES)
    u, v = away[None, :], away[:, None]
    patch = sampled(image, x + np.cos(angle) * u - np.sin(angle) * v, y + np.sin(angle) * u + np.cos(angle) * v)
    dx = patch[1:-1, 2:] - patch[1:-1, :-2]
    dy = patch[2:, 1:-1] - patch[:-2, 1:-1]
    weights = np.exp(-0.5 * ((np.arange(SAMPLES) - (SAMPLES - 1) / 2) / sigma) ** 2)
    return (np.hypot(dx, dy) * weights * weights[:, None], np.mod(np.arctan2(dy, dx), 2 * np.pi) * bins / (2 * np.pi))


def shares(directions, bins):
    """How much directions [...] count for each bin [..., bins]."""
    away = np.abs(directions[..., None] - np.arange(bins))
    return np.maximum(1 - np.minimum(away, bins - away), 0)


def orientations(octaves, keypoint):
    """One or two angles, the highest peak first."""
    lengths, directions = gradients(octaves, keypoint, 0.48, 0, 1.5 / 0.48, 36)
    turns = np.einsum("rc,rcb->b", lengths, shares(directions, 36))
    for _ in range(6):
        turns = (np.roll(turns, 1) + turns + np.roll(turns, -1)) / 3
    before, after = np.roll(turns, 1), np.roll(turns, -1)
    peaks = np.flatnonzero((turns > before) & (turns > after) & (turns > 0.8 * turns.max()))
    peaks = peaks[np.argsort(-turns[peaks], kind="stable")][:2]
    shift = (before - after)[peaks] / (2 * (before - 2 * turns + after)[peaks])
    return (peaks + shift) * 2 * np.pi / 36


def descriptor(octaves, keypoint, angle):
    """[128] before it is rounded: RootSIFT times 512."""
    lengths, directions = gradients(octaves, keypoint, 0.75, angle, 2 * CELL, 8)
    at = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) / CELL
    cells = np.maximum(1 - np.abs(at[:, None] - (np.arange(4) - 1.5)), 0)  # [20, 4]
    values = np.einsum("rc,ri,cj,rcb->ijb", lengths, cells, cells, shares(directions, 8)).ravel()
    values = np.minimum(values, 0.2 * np.linalg.norm(values))
    return 512 * np.sqrt(values / max(values.sum(), 1e-300))
