"""Signed distances of samples of bricks from the surface that views show, one after the other."""

import numpy as np

CELLS = 32  # of a brick along each side; it has one sample more
SURE, COARSEST, MOST_PASSES = 2, 4, 0.5


def samples_of(brick, voxel):
    """float64[N, 3], world: the samples of a brick, z the fastest."""
    steps = np.indices(3 * [CELLS + 1]).reshape(3, -1).T
    return voxel * (CELLS * np.asarray(brick) + steps)


def depth_at(depth, pixels, truncation):
    """The bilinear depths float64[N] at pixels [N, 2]; nan where there is none."""
    height, width = depth.shape
    (x, y), (fx, fy) = (
        np.array(pair) for pair in zip(*(_between(axis, size) for axis, size in zip(pixels.T, (width, height))))
    )
    x, y = x.astype(int), y.astype(int)
    four = np.stack([depth[y, x], depth[y, x + 1], depth[y + 1, x], depth[y + 1, x + 1]])
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    found = (weights * four).sum(axis=0)
    return np.where(np.ptp(four, axis=0) < truncation, found, np.nan)


def _between(places, size):
    """The pixel before each place along an axis, and the share of the one behind it."""
    first = np.clip(np.floor(places - 0.5), 0, size - 2)
    return first, np.clip(places - 0.5 - first, 0, 1)


def signed_distance(bricks, voxel, truncation, views):
    """Sums float64[7, B, N] of the samples of bricks int[B, 3].

    views: (chosen bricks, rotation, translation, focal, centre, near, depth [H, W], first [H, W],
    transmittance [H, W], image [3, H, W]) of each.
    """
    sums = np.zeros((7, len(bricks), (CELLS + 1) ** 3))
    for chosen, rotation, translation, focal, centre, near, *planes in views:
        depth, first, transmittance, image = planes
        for brick in chosen:
            x, y, z = rotation @ samples_of(bricks[brick], voxel).T + translation[:, None]
            pixels = np.stack([x / z * focal[0] + centre[0], y / z * focal[1] + centre[1]], 1)
            shown = np.flatnonzero((z > near) & (pixels >= 0).all(axis=1) & (pixels < depth.shape[::-1]).all(axis=1))
            column, row = pixels[shown].astype(int).T
            found = depth_at((depth + first) / 2, pixels[shown], truncation)
            size = found / focal[0]
            with np.errstate(divide="ignore", invalid="ignore"):  # where there is no depth
                unsure = (depth[row, column] - first[row, column]) / (SURE * size)
            weight = 1 / (1 + unsure**2)
            d = np.minimum((found - z[shown]) / truncation, 1)
            counts = (
                (found > 0)
                & (d >= -1)
                & (size <= COARSEST * voxel)  # neither for nan
                & (transmittance[row, column] <= MOST_PASSES)
            )
            near_surface = weight * (1 - abs(d))
            values = np.stack(
                [weight * d, weight, np.ones(len(d)), *near_surface * image[:, row, column], near_surface]
            )
            sums[:, brick, shown[counts]] += values[:, counts]
    return sums
