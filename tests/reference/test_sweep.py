"""The reference of the plane sweep finds the depth of an analytic plane, whatever the exposure."""

import numpy as np
import pytest

from tests.reference.sweep import sweep

FOCAL, DEPTH, WIDTH, HEIGHT = 40.0, 5.0, 30, 24
SPACING, PLANES = 0.005, 31
MOVES = np.array([[0, 0, 0], [0.4, 0.1, 0], [-0.3, 0.3, 0.1], [0.1, -0.4, -0.1]])
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def photos_of(slant):
    """Photos [V, H, W] of waves on the plane z = DEPTH + slant x, from cameras that do not turn,
    with the plane's inverse depth in the first [H, W]."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = (x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL
    photos = []
    for move in MOVES:  # the camera is at -move
        z = (DEPTH + move[2] - slant * move[0]) / (1 - slant * rays[0])
        u, v = rays[0] * z - move[0], rays[1] * z - move[1]
        photos.append(0.5 + 0.15 * (np.sin(6 * u + 3 * v) + np.sin(8 * v - 3 * u + 1)))
    return np.stack(photos), (1 - slant * rays[0]) / DEPTH


def found(photos):
    """Without turns a pixel moves by the intrinsics times the camera's move, by inverse depth."""
    warps = [[*np.eye(3).ravel(), *INTRINSICS @ move] for move in MOVES[1:]]
    sizes = [(WIDTH, HEIGHT)] * len(MOVES)
    return sweep(photos, sizes, [1, 2, 3], np.array(warps), 0.13, SPACING, PLANES)


@pytest.mark.parametrize("slant", [0, 0.2])
def test_the_depth_of_a_plane(slant):
    photos, inverse = photos_of(slant)
    depths, scores, _ = found(photos)
    inner = np.s_[3:-3, 3:-3]
    assert np.mean(np.abs(depths / inverse - 1)[inner] < 0.01) > 0.95
    assert np.median(scores[inner]) > 0.99 and not np.delete(depths, np.s_[3:-3], axis=0).any()


@pytest.mark.slow
def test_gain_and_offset_of_a_photo_do_not_matter():
    photos, _ = photos_of(0.2)
    for number in range(len(photos)):
        changed = photos.copy()
        changed[number] = 0.6 * photos[number] + 0.2
        for values, same in zip(found(changed)[:2], found(photos)):
            assert np.mean(np.abs(values - same) < 1e-9) > 0.99  # where texture is not too weak
