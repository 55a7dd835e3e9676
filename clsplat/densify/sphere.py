"""Sphere-Constrained Gaussians (Xue et al. 2026, section 4): no gaussian strays from the cloud.

Each has an anchor and a max_offset. One whose distance from its anchor passes `reach` x max_offset
is removed: a prune, not a clamp. A clone is anchored where it stands and inherits max_offset. A
child of a split inherits the anchor and a share of max_offset; the released code anchors it at its
own place instead.
"""

import numpy as np

from clsplat.gaussians import Gaussians, mean_neighbour_distance


def with_spheres(gaussians, neighbours):
    """Initial `gaussians` with anchors where they stand and max_offsets, world units: the mean
    distance to so many nearest others."""
    offsets = mean_neighbour_distance(gaussians.positions.astype(np.float64), neighbours)
    return Gaussians({**gaussians.rows, "anchors": gaussians.positions.copy(),
                      "max_offsets": offsets.astype(np.float32)}, gaussians.sh_degree)


def outside(positions, anchors, max_offsets, reach):
    """bool[N]: whether positions [N, 3] are beyond reach x max_offsets [N] from anchors [N, 3];
    what is not a number counts as outside."""
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(positions.astype(np.float64) - anchors, axis=1)
        return ~(distance <= reach * max_offsets.astype(np.float64))


def children(parents, positions, options):
    """(anchors [S, 3], max_offsets [S]) of split children at `positions`, from their parents' rows
    (dict of anchors and max_offsets); options: TrainOptions."""
    anchors = positions if options.sphere_rule == "release" else parents["anchors"]
    return (anchors.astype(np.float32),
            (parents["max_offsets"] * options.sphere_shrink).astype(np.float32))
