"""Where the rays of pixels pass gaussians: the mean depth of those points of a gaussian that
project to a pixel, as the projection is linearised."""

import numpy as np

from tests.reference.project import _forward


def ray_depth(rows, camera, numbers, near, low_pass=0.3):
    """depth[H, W]; numbers[H, W]: the gaussian of each pixel, from 1; 0: none, and the depth is 0."""
    f = _forward(rows, camera, 0, low_pass, False)
    # rows of the three by which its whitened points move in the picture and along the axis
    forward = camera["rotation"][2] @ f["body"]
    moves = np.concatenate([f["b"], forward[:, None]], axis=1) * f["scales"][:, None]
    covariance = moves @ moves.swapaxes(1, 2)
    picture = covariance[:, :2, :2] + low_pass * np.eye(2)
    slopes = np.linalg.solve(picture, covariance[:, :2, 2:])[..., 0]
    line, column = np.indices(numbers.shape) + 0.5
    row = np.maximum(numbers, 1) - 1
    away = np.stack([column, line], axis=-1) - f["mean"][row]
    depth = f["p"][row, 2] + (slopes[row] * away).sum(axis=-1)
    return np.where(numbers > 0, np.maximum(depth, near), 0)
