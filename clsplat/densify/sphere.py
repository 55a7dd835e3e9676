"""Sphere-Constrained Gaussians (Xue et al. 2026, section 4): gaussians stay near the sparse points.

Each has an anchor and a max_offset. One that is further from its anchor than `reach` x max_offset
is pruned, not clamped. The anchor of a clone is its own position, and it inherits max_offset. A
child of a split inherits the anchor and a share of max_offset; in the released code its anchor is
its own position.
"""

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians, mean_neighbour_distance


def with_spheres(gaussians: Gaussians, neighbours: int) -> Gaussians:
    """Initial gaussians, on the sparse points, with spheres around their positions; max_offset is
    the mean distance to the `neighbours` nearest others."""
    offsets = mean_neighbour_distance(gaussians.positions.astype(np.float64), neighbours)
    return Gaussians(
        {**gaussians.rows, "anchors": gaussians.positions.copy(), "max_offsets": offsets.astype(np.float32)},
        gaussians.sh_degree,
    )


def outside(
    positions: NDArray[np.float32], anchors: NDArray[np.float32], max_offsets: NDArray[np.float32], reach: float
) -> NDArray[np.bool_]:
    """Which positions [N, 3] are further than reach x max_offsets [N] from their anchors [N, 3], or
    not a number."""
    with np.errstate(over="ignore", invalid="ignore"):
        away = positions.astype(np.float64) - anchors
        distance = np.sqrt(np.einsum("ij,ij->i", away, away))
        inside: NDArray[np.bool_] = distance <= reach * max_offsets.astype(np.float64)
    return ~inside
