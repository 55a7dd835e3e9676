"""Sphere-Constrained Gaussians (Xue et al. 2026, section 4): gaussians stay near the sparse points.

Each has an anchor and a max_offset. One that is further from its anchor than `reach` x max_offset
is pruned, not clamped. The anchor of a clone is its own position, and it inherits max_offset. A
child of a split inherits the anchor and a share of max_offset; in the released code its anchor is
its own position.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians, mean_neighbour_distance

if TYPE_CHECKING:
    from clsplat.densify.options import GrowthOptions

ROWS_AT_A_TIME = 1 << 14  # so few that numbers between two operations stay in the cache
NEARLY = 1 - 1e-5  # of a radius: a length in single precision is surely within it
TINY = 1e-18  # a length whose square is too small for single precision is shorter


def with_spheres(gaussians: Gaussians, neighbours: int) -> Gaussians:
    """Initial gaussians, on the sparse points, with spheres around their positions; max_offset is
    the mean distance to the `neighbours` nearest others."""
    offsets = mean_neighbour_distance(gaussians.positions.astype(np.float64), neighbours)
    return Gaussians({**gaussians.rows, "anchors": gaussians.positions.copy(),
                      "max_offsets": offsets.astype(np.float32)}, gaussians.sh_degree)


def outside(positions: NDArray[np.float32], anchors: NDArray[np.float32],
            max_offsets: NDArray[np.float32], reach: float) -> NDArray[np.bool_]:
    """Which positions [N, 3] are further than reach x max_offsets [N] from their anchors [N, 3], or
    not a number."""
    inside = np.empty(len(positions), bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for begin in range(0, len(positions), ROWS_AT_A_TIME):
            rows = slice(begin, begin + ROWS_AT_A_TIME)
            x, y, z = (positions[rows] - anchors[rows]).T
            inside[rows] = (np.sqrt(x * x + y * y + z * z)
                            < NEARLY * reach * max_offsets[rows] - TINY)
        # single precision cannot tell for the others
        rest = np.flatnonzero(~inside)
        away = positions.take(rest, axis=0).astype(np.float64) - anchors.take(rest, axis=0)
        distance = np.sqrt(np.einsum("ij,ij->i", away, away))
        inside[rest] = distance <= reach * max_offsets[rest].astype(np.float64)
    return ~inside


def children(parents: dict[str, NDArray[np.float32]], positions: NDArray[np.float32],
             options: GrowthOptions) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The anchors [S, 3] and max_offsets [S] of the children of splits, from those of each child's
    parent and the children's positions float32[S, 3]."""
    anchors = positions if options.sphere_rule == "release" else parents["anchors"]
    return (anchors.astype(np.float32),
            (parents["max_offsets"] * options.sphere_shrink).astype(np.float32))
