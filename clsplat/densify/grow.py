"""Adaptive density control of 3DGS (Kerbl et al. 2023, section 5.2), decided on the host.

Where the mean screen gradient is high, small gaussians are cloned and large ones split in two;
faint and oversized ones are pruned. Decisions are numpy on a few numbers a gaussian; the rows
themselves move on the device.
"""

from dataclasses import dataclass

import numpy as np

SPLIT_SHRINK = 1.6
CHILDREN = 2


@dataclass(frozen=True, eq=False)
class Growth:
    """What becomes of N rows. source: uint32[M], the old row of each new row; the first `kept` are
    old rows that stay, then clones, then the children of splits. split: slice of the children, of
    whose rows `positions` and `log_scales` (float32[S, 3]) replace the parents'."""

    source: np.ndarray
    kept: int
    split: slice
    positions: np.ndarray
    log_scales: np.ndarray
    cloned: int
    pruned: int


def plan_growth(gradient, rows, extent, options, prune_large, rng):
    """A Growth from mean screen gradients float[N] and host rows of every field but the harmonics.

    extent: scene extent, world units; options: TrainOptions; prune_large: also remove gaussians
    above options.prune_size; rng: numpy Generator, for the places of split children.
    """
    count = len(gradient)
    scales = np.exp(rows["log_scales"].astype(np.float64))
    largest = scales.max(axis=1)
    opacity = 1 / (1 + np.exp(-rows["opacity_logits"].astype(np.float64)))
    grows = gradient >= options.grow_threshold
    if options.max_gaussians:
        grows &= _highest(gradient, options.max_gaussians - count)
    splits = np.flatnonzero(grows & (largest > options.split_size * extent))
    clones = np.flatnonzero(grows & (largest <= options.split_size * extent))

    # written to drop what is not a number, too
    visible = opacity >= options.prune_opacity
    limit = options.prune_size * extent if prune_large else np.finfo(float).max
    keeps = visible & (largest <= limit)
    children = np.repeat(splits, CHILDREN)
    # drawn for every child, so that pruning one does not move another
    offsets = _rotated(rows["quaternions"][children],
                       rng.standard_normal((len(children), 3)) * scales[children])
    child_keeps = (visible & (largest / SPLIT_SHRINK <= limit))[children]

    stays = keeps.copy()
    stays[splits] = False
    stays = np.flatnonzero(stays)
    clones = clones[keeps[clones]]
    children, offsets = children[child_keeps], offsets[child_keeps]
    source = np.concatenate([stays, clones, children]).astype(np.uint32)
    return Growth(
        source, len(stays), slice(len(source) - len(children), len(source)),
        (rows["positions"][children] + offsets).astype(np.float32),
        np.log(scales[children] / SPLIT_SHRINK).astype(np.float32),
        len(clones), count - len(stays) - len(children) // CHILDREN)


def _highest(gradient, room):
    """The mask of the `room` highest gradients; a clone and a split each add one gaussian."""
    chosen = np.zeros(len(gradient), bool)
    if room > 0:
        chosen[np.argsort(-gradient, kind="stable")[:room]] = True
    return chosen


def _rotated(quaternions, vectors):
    """Vectors float64[N, 3] turned by quaternions[N, 4] wxyz of any length."""
    q = quaternions.astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-30)
    axis = q[:, 1:]
    twice = 2 * np.cross(axis, vectors)
    return vectors + q[:, :1] * twice + np.cross(axis, twice)
