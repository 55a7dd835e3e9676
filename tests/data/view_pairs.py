"""Two photographed views of one textured plane, as the tests of reprojection want them."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests import cases

NORMAL, DISTANCE = np.array([0.1, -0.2, 1.0]), 4.0  # of the plane, in the first camera's frame
IDENTITY = np.eye(3, 4)


def view_pair(size, other_size=None, seed=0, turn=(0.02, -0.05, 0.03), move=(0.3, -0.15, 0.1)):
    """Cameras (first, other) as `tests.reference.project` takes them, photo and neighbour
    uint8[3, H, W], and the first view's z-depth float64[H, W].

    turn: rotation vector from the first camera to the other; move: translation of it, world units.
    """
    first = {
        **cases.camera(*size),
        "translation": np.array([5.0, -2, 7]),
        "rotation": Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix(),
    }
    relative, move = Rotation.from_rotvec(turn).as_matrix(), np.array(move, float)
    other = {
        **cases.camera(*(other_size or size)),
        "rotation": relative @ first["rotation"],
        "translation": relative @ first["translation"] + move,
    }
    depth = DISTANCE / np.tensordot(NORMAL, _rays(first), 1)
    rays = _rays(other)
    z = (DISTANCE + NORMAL @ relative.T @ move) / np.tensordot(NORMAL @ relative.T, rays, 1)
    seen = np.tensordot(relative.T, z * rays - move[:, None, None], 1)
    return (first, other), _texture(depth * _rays(first), seed), _texture(seen, seed), depth


def _rays(camera):
    line, column = np.mgrid[: camera["height"], : camera["width"]] + 0.5
    return np.stack([(column - camera["cx"]) / camera["fx"], (line - camera["cy"]) / camera["fy"], np.ones(line.shape)])


def _texture(points, seed):
    """Bytes [3, H, W] of a smooth pattern at points [3, H, W] of the plane."""
    phase = np.random.default_rng(seed).uniform(0, 6, (3, 1, 1))
    x, y, _ = points
    return np.round(127 + 90 * np.sin(1.9 * x + phase) * np.cos(1.3 * y - phase)).astype(np.uint8)
