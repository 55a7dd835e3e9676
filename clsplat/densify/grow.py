"""Adaptive density control of 3DGS (Kerbl et al. 2023, section 5.2), decided on the host.

Of the gaussians chosen to grow, small ones are cloned and large ones split in two; faint, oversized
and strayed ones are pruned. Decisions are numpy on a few numbers a gaussian; the rows themselves
move on the device.
"""

from dataclasses import dataclass

import numpy as np

from clsplat.densify.sphere import children as sphere_children
from clsplat.densify.sphere import outside

SPLIT_SHRINK = 1.6
CHILDREN = 2


@dataclass(frozen=True, eq=False)
class Growth:
    """What becomes of N rows. source: uint32[M], the old row of each new row; the first `kept` are
    old rows that stay, then `cloned` clones, then the children of `split` parents; `pruned` rows
    leave nothing. changes: field -> (first row, float32 values), where new rows differ from their
    source."""

    source: np.ndarray
    kept: int
    cloned: int
    split: int
    pruned: int
    changes: dict


class Candidates:
    """The rows of N gaussians as growth sees them, and which of them must go.

    rows: host rows of every field but the harmonics; extent: of the scene, world units; options:
    TrainOptions; prunes_large: also remove gaussians above options.prune_size.
    """

    def __init__(self, rows, extent, options, prunes_large):
        self.rows, self.options = rows, options
        self.scales = np.exp(rows["log_scales"].astype(np.float64))
        self.largest = self.scales.max(axis=1)
        limited = prunes_large and options.prune_size > 0
        self.limit = options.prune_size * extent if limited else np.finfo(float).max
        self.is_small = self.largest <= options.split_size * extent
        with np.errstate(over="ignore"):  # an infinity makes an opacity of 0, which is right
            opacity = 1 / (1 + np.exp(-rows["opacity_logits"].astype(np.float64)))
        # written to drop what is not a number, too
        self.visible = opacity >= options.prune_opacity
        if "anchors" in rows:
            self.visible &= ~outside(rows["positions"], rows["anchors"], rows["max_offsets"],
                                     options.sphere_reach)

    @property
    def prunes(self):
        """bool[N]: faint, strayed or too large."""
        return ~(self.visible & (self.largest <= self.limit))


def plan_growth(candidates, grows, prunes, rng):
    """The Growth that clones or splits the rows of `grows` bool[N] and removes those of `prunes`.

    What is split may be in `prunes` for its size, if its children are small enough. rng: numpy
    Generator, for the places of the children.
    """
    rows, options, scales = candidates.rows, candidates.options, candidates.scales
    splits = np.flatnonzero(grows & ~candidates.is_small)
    clones = np.flatnonzero(grows & candidates.is_small & ~prunes)
    children = np.repeat(splits, CHILDREN)
    # drawn for every child, so that pruning one does not move another
    offsets = _rotated(rows["quaternions"][children],
                       rng.standard_normal((len(children), 3)) * scales[children])
    positions = (rows["positions"][children] + offsets).astype(np.float32)
    # a parent that goes only for its size may leave children
    lives = (candidates.visible | ~prunes) & (candidates.largest / SPLIT_SHRINK <= candidates.limit)
    keeps = lives[children]
    spheres = {}
    if "anchors" in rows:
        parents = {name: rows[name][children] for name in ("anchors", "max_offsets")}
        anchors, max_offsets = sphere_children(parents, positions, options)
        keeps &= ~outside(positions, anchors, max_offsets, options.sphere_reach)
        spheres = {"anchors": anchors[keeps], "max_offsets": max_offsets[keeps]}

    stays = ~prunes
    stays[splits] = False
    stays = np.flatnonzero(stays)
    first = len(stays) + len(clones)
    changes = {"positions": positions[keeps],
               "log_scales": np.log(scales[children][keeps] / SPLIT_SHRINK).astype(np.float32),
               **spheres}
    changes = {name: (first, values) for name, values in changes.items()}
    if spheres:  # a clone is anchored where it stands
        anchors = np.concatenate([rows["positions"][clones], spheres["anchors"]])
        changes["anchors"] = len(stays), anchors.astype(np.float32)
    source = np.concatenate([stays, clones, children[keeps]]).astype(np.uint32)
    split = len(np.unique(children[keeps]))
    return Growth(source, len(stays), len(clones), split,
                  len(rows["positions"]) - len(stays) - split, changes)


def _rotated(quaternions, vectors):
    """Vectors float64[N, 3] turned by quaternions[N, 4] wxyz of any length."""
    q = quaternions.astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-30)
    axis = q[:, 1:]
    twice = 2 * np.cross(axis, vectors)
    return vectors + q[:, :1] * twice + np.cross(axis, twice)
