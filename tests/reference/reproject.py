"""Squared colour difference of a view's pixels, moved by their depth, and an adjacent photo.

Cameras are dicts as `tests.reference.project` takes them; pixel centres at (0.5, 0.5). Images are
in display values, [3, H, W].
"""

import numpy as np

COVERED = 0.5
NEAREST = 0.1


def reproject(depth, transmittance, photo, neighbour, cameras, colour):
    """squares[H, W] (zero where not valid), valid bool[H, W], and the gradients [H, W] of the mean
    of the valid squares by depth and by transmittance.

    cameras: of `photo` and of `neighbour`. colour[3, 4]: takes the neighbour's colours to the
    photo's, the last column added.
    """
    cover = 1 - transmittance
    z = np.divide(depth, cover, out=np.zeros(depth.shape), where=cover > COVERED)
    found, (u, v), (du, dv) = _find(z, *cameras)
    height, width = neighbour.shape[1:]
    x, y = u - 0.5, v - 0.5
    valid = found & (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    squares, by_z = np.zeros(z.shape), np.zeros(z.shape)
    sample, by_x, by_y = _bilinear(neighbour, x[valid], y[valid])
    difference = colour[:, :3] @ sample + colour[:, 3:] - photo[:, valid]
    squares[valid] = (difference**2).sum(0)
    by_z[valid] = 2 * np.sum(difference * (colour[:, :3] @ (by_x * du[valid] + by_y * dv[valid])), axis=0)
    by_z /= max(valid.sum(), 1)
    by_depth = np.divide(by_z, cover, out=np.zeros(z.shape), where=valid)
    by_transmittance = np.divide(by_z * depth, cover**2, out=np.zeros(z.shape), where=valid)
    return squares, valid, by_depth, by_transmittance


def fragile_pixels(depth, transmittance, neighbour, cameras, tolerance=1e-4):
    """bool[H, W]: pixels whose being valid, or whose four texels, are decided by less than
    `tolerance` (of a pixel; relative for depths)."""
    cover = 1 - transmittance
    z = np.divide(depth, cover, out=np.zeros(depth.shape), where=cover != 0)
    _, (u, v), _ = _find(z, *cameras)
    near = _moved(z, *cameras)[2]
    texel = np.abs(np.stack([u - 0.5, v - 0.5]) - np.round(np.stack([u - 0.5, v - 0.5])))
    return (
        (np.abs(cover - COVERED) < tolerance)
        | (texel < tolerance).any(0)
        | (np.abs(near - NEAREST * z) < tolerance * z)
    )


def _find(z, camera, other):
    """Which pixels at depths z are in front of the other camera, where they are in its image
    (u, v), pixels, and the derivatives of u and v by z."""
    x, y, w = _moved(z, camera, other)
    dx, dy, dw = _moved(z + 1, camera, other) - (x, y, w)  # linear in z
    found = (z > 0) & np.isfinite(z) & (w > NEAREST * z)
    w = np.where(found, w, 1)
    u, v = other["fx"] * x / w + other["cx"], other["fy"] * y / w + other["cy"]
    return found, (u, v), (other["fx"] * (dx - x / w * dw) / w, other["fy"] * (dy - y / w * dw) / w)


def _moved(z, camera, other):
    """Pixel centres at depths z, by way of the world, in the other camera's frame [3, H, W]."""
    line, column = np.mgrid[: z.shape[0], : z.shape[1]] + 0.5
    points = np.stack(
        [(column - camera["cx"]) / camera["fx"] * z, (line - camera["cy"]) / camera["fy"] * z, z]
    ).reshape(3, -1)
    world = camera["rotation"].T @ (points - camera["translation"][:, None])
    return (other["rotation"] @ world + other["translation"][:, None]).reshape(3, *z.shape)


def _bilinear(image, x, y):
    """Values [3, N] at x, y (pixel centres at whole numbers), and their derivatives by both."""
    left, above = np.floor(x).astype(int), np.floor(y).astype(int)
    values, by_x, by_y = np.zeros((3, 3, len(x)))
    for column in (0, 1):
        for line in (0, 1):
            texel = image[:, above + line, left + column]
            across = 1 - np.abs(x - left - column)
            down = 1 - np.abs(y - above - line)
            values += texel * across * down
            by_x += texel * (2 * column - 1) * down
            by_y += texel * (2 * line - 1) * across
    return values, by_x, by_y
