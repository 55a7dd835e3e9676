"""Fewer triangles for the same surface: vertices of one cell become one where that hardly moves the
surface and hardly changes its colours (Rossignac & Borrel 1993, with the quadrics of Garland &
Heckbert 1997 in an octree, as Schaefer & Warren 2003)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Triangles = NDArray[np.integer]
CELLS = (16, 8, 4, 2)  # their sides, voxels; the largest that may be merged is
FLAT = 0.4  # voxels, the root of the mean squared distance from the planes of triangles, at most
ALIKE = 8.0  # of 255, the standard deviation of colours, at most
ROUNDS, SLIVER = 8, 0.5  # of taking folds apart; voxels squared, of a triangle that is none
STIFF = 1e-3  # share of the largest eigenvalue: so little holds a vertex where planes do not
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of axes, of a symmetric matrix


def edges_of(triangles: Triangles) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """The edges int64[E, 2] of triangles int[M, 3], the smaller vertex first, and in how many
    triangles each is: int[E]."""
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    keys, counts = np.unique(sides[:, 0] << 32 | sides[:, 1], return_counts=True)
    return np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1), counts


def decimated(
    vertices: Floats, colours: Floats, triangles: Triangles, keep: NDArray[np.bool_]
) -> tuple[Floats, Floats, Triangles, NDArray[np.bool_]]:
    """Merge vertices.

    Parameters
    ----------
    vertices : float64[N, 3], in voxels.
    colours : float64[N, 3], 0 to 255.
    triangles : int[M, 3], vertices.
    keep : bool[N], vertices that stay where they are, as do those of open edges.

    Returns
    -------
    The same four for the vertices that are left; triangles that became an edge or a point are left
    out, and both of two that became equal.
    """
    edges, counts = edges_of(triangles)
    free = ~keep
    free[edges[counts == 1]] = False
    middle = vertices.mean(axis=0) if len(vertices) else np.zeros(3)
    quadrics = _quadrics(vertices - middle, triangles)  # squares of small numbers keep digits
    cluster, places, tints = np.full(len(vertices), -1), [], []
    now, cell, number = vertices.copy(), np.full(len(vertices), -1), 0
    for side in CELLS:
        rows = np.flatnonzero(free & (cluster < 0))
        _, of = np.unique(np.floor(vertices[rows] / side).astype(np.int64), axis=0, return_inverse=True)
        of = of.reshape(-1)
        size = np.bincount(of)

        def sums(values: Floats, of: NDArray[np.intp] = of) -> Floats:
            return np.stack([np.bincount(of, column) for column in values.T], axis=1)

        mean, tint = (sums(each[rows]) / size[:, None] for each in (vertices, colours))
        place, error = _best(sums(quadrics[rows]), mean - middle)
        place += middle
        spread = (sums(colours[rows] ** 2) / size[:, None] - tint**2).max(axis=1, initial=0)
        good = (
            (size > 1) & (error < FLAT**2) & (spread < ALIKE**2) & (np.abs(place - mean).max(axis=1, initial=0) < side)
        )
        cell[rows] = of
        for _ in range(ROUNDS):  # without cells that would fold the surface
            trial = now.copy()
            trial[rows[good[of]]] = place[of[good[of]]]
            folding = cell[triangles[_turned(vertices, trial, triangles)]]
            folding = folding[folding >= 0]
            if not good[folding].any():
                break
            good[folding] = False
        now[rows[good[of]]] = place[of[good[of]]]
        cell[rows] = -1
        names = np.cumsum(good) - 1 + number
        cluster[rows] = np.where(good[of], names[of], -1)
        places.append(place[good])
        tints.append(tint[good])
        number += int(good.sum())
    alone = cluster < 0
    cluster[alone] = number + np.arange(alone.sum())
    moved = np.concatenate([*places, vertices[alone]])
    tinted = np.concatenate([*tints, colours[alone]])
    kept = np.concatenate([np.zeros(number, bool), keep[alone]])
    faces = cluster[triangles]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    # two that have become the same are a fold: without both, no edge is open that was not
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return moved, tinted, faces[np.sort(first[counts % 2 == 1])], kept


def _turned(before: Floats, after: Floats, triangles: Triangles) -> NDArray[np.bool_]:
    """bool[M]: which triangles face the other way once their vertices have moved, but slivers."""
    old, new = (
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        for corners in (before[triangles], after[triangles])
    )
    turned: NDArray[np.bool_] = (np.einsum("ij,ij->i", old, new) < 0) & (
        np.einsum("ij,ij->i", new, new) > (2 * SLIVER) ** 2
    )
    return turned


def _quadrics(vertices: Floats, triangles: Triangles) -> Floats:
    """float64[N, 11]: the sums over the triangles at a vertex of the matrix, the vector, the number
    and the weight of the squared distance from their planes, x A x + 2 b x + c."""
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-12)[:, None]
    away = -np.einsum("ij,ij->i", normal, corners[:, 0])
    terms = [*(normal[:, i] * normal[:, j] for i, j in PAIRS), *(normal.T * away), away**2, np.ones(len(area))]
    return np.stack(
        [np.bincount(triangles.ravel(), np.repeat(term * area, 3), len(vertices)) for term in terms], axis=1
    )


def _best(quadrics: Floats, means: Floats) -> tuple[Floats, Floats]:
    """The places float64[K, 3] nearest to planes, and to the means where the planes leave that
    open, and the mean squared distance there float64[K]."""
    matrix = np.empty((len(quadrics), 3, 3))
    for column, (i, j) in enumerate(PAIRS):
        matrix[:, i, j] = matrix[:, j, i] = quadrics[:, column]
    vector, weight = quadrics[:, 6:9], np.maximum(quadrics[:, 10], 1e-12)
    held = STIFF * np.maximum(np.trace(matrix, axis1=1, axis2=2), 1e-12)
    slope = np.einsum("kij,kj->ki", matrix, means) + vector
    step = np.linalg.solve(matrix + held[:, None, None] * np.eye(3), -slope[..., None])[..., 0]
    place = means + step
    error = np.einsum("ki,kij,kj->k", place, matrix, place) + 2 * np.einsum("ki,ki->k", vector, place) + quadrics[:, 9]
    return place, error / weight
