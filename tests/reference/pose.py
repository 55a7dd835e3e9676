"""Corrections of a camera's pose, their gradient and what learns them.

A pose is (turn[3], shift[3]) in the axes of the given camera, a dict as in project.py: the centre
moves by depth R^T shift, and R becomes exp([turn]x) R.
"""

import numpy as np

from tests.reference.adam import adam
from tests.reference.project import project_adjoint, rotations


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def exponential(turn):
    """The rotation matrix of a rotation vector, and the left Jacobian of that map, by series."""
    matrix, term, jacobian = np.eye(3), np.eye(3), np.eye(3)
    for k in range(1, 40):
        term = term @ cross_matrix(turn) / k
        matrix = matrix + term
        jacobian = jacobian + term / (k + 1)
    return matrix, jacobian


def apply(camera, pose, depth):
    """The camera with its pose corrected."""
    turned = exponential(pose[:3])[0] @ camera["rotation"]
    position = -camera["rotation"].T @ camera["translation"] + depth * camera["rotation"].T @ pose[3:]
    return {**camera, "rotation": turned, "translation": -turned @ position}


def terms(rows, camera, degree, near, antialiased=False, *, grads):
    """[N, 6]: by a turn of what the camera sees about its centre, and by the positions, world."""
    arguments = dict(antialiased=antialiased, grads=grads)
    by_rows = project_adjoint(rows, camera, degree, near, **arguments)
    # a turn of the camera leaves the directions of the harmonics alone: as if there were none
    still = project_adjoint(rows, camera, 0, near, **arguments)
    rotation = camera["rotation"]
    p = rows["positions"] @ rotation.T + camera["translation"]
    body, unit, length = rotations(rows["quaternions"])
    w, v = unit[:, :1], unit[:, 1:]
    by_w, by_v = still["quaternions"][:, :1], still["quaternions"][:, 1:]
    # the derivative of |q| unit (0, turn) / 2 by the turn, in the gaussian's own axes
    own = length / 2 * (w * by_v - v * by_w + np.cross(by_v, v))
    turn = np.cross(p, still["positions"] @ rotation.T) + np.einsum("ij,njk,nk->ni", rotation, body, own)
    return np.concatenate([turn, by_rows["positions"]], axis=1)


def gradient(camera, pose, depth, sums):
    """[6], the gradient by a pose, from the sums of `terms` for the corrected camera."""
    return np.concatenate([exponential(pose[:3])[1].T @ sums[:3], -depth * camera["rotation"] @ sums[3:]])


def step(poses, first, second, counts, view, grad, rate, pull):
    """New (poses [V, 6], moments, counts [V]) after a step on one view, as exposure.py has it."""
    if not np.isfinite(grad).all() or rate == 0:
        return poses, first, second, counts
    counts = counts.copy()
    counts[view] += 1
    spread = np.zeros_like(poses)
    spread[view] = grad + pull * poses[view]
    return *adam(poses, spread, first, second, int(counts[view]), rate, rows=[view]), counts
