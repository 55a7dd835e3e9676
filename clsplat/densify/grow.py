"""Adaptive density control of 3DGS (Kerbl et al. 2023, section 5.2), decided on the host.

Of the gaussians chosen to grow, small ones are cloned and large ones split in two. Those that are
transparent, too large or outside their sphere are pruned. Decisions are made with numpy from a few
numbers of each gaussian; the rows themselves are moved on the device.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.sphere import children as sphere_children
from clsplat.densify.sphere import outside

if TYPE_CHECKING:
    from clsplat.options import TrainOptions

SPLIT_SHRINK = 1.6
SHRINK = np.log(SPLIT_SHRINK)
CHILDREN = 2


@dataclass(frozen=True, eq=False)
class Growth:
    """How a round of growth makes M new rows from N old ones.

    Attributes
    ----------
    source : uint32[M], the old row of each new row: first the rows that stay, then clones, then the
        children of splits; or after those that stay all that share in a relocation.
    kept : how many rows stay, with their moments.
    cloned : how many rows are cloned.
    split : how many rows are replaced by their children.
    pruned : how many rows are removed without children.
    changes : field name -> (first new row, values), where new rows differ from their source.
    """

    source: NDArray[np.uint32]
    kept: int
    cloned: int
    split: int
    pruned: int
    changes: dict[str, tuple[int, NDArray[np.float32]]]


class Candidates:
    """What growth knows of N gaussians.

    Parameters
    ----------
    rows : field name -> float32[N, *row shape], every field but the spherical harmonics (SH).
    extent : of the scene, world units.
    options : of the training.
    prunes_large : whether gaussians larger than the option `prune_size` are removed.

    Attributes
    ----------
    largest : float32[N], the largest of the three logarithms of standard deviations, world units.
    limit : the logarithm of the largest standard deviation that is not pruned.
    is_small : bool[N], those that are cloned rather than split.
    visible : bool[N], those neither transparent nor outside their sphere.
    """

    def __init__(self, rows: dict[str, NDArray[np.float32]], extent: float, options: TrainOptions,
                 prunes_large: bool) -> None:
        self.rows, self.options = rows, options
        # thresholds are taken to logarithms and logits rather than all rows from them
        x, y, z = rows["log_scales"].T
        self.largest = np.maximum(np.maximum(x, y), z)  # thirty times as fast as a reduction
        limited = prunes_large and options.prune_size > 0
        with np.errstate(divide="ignore"):  # a threshold of 0 or 1 is infinite
            self.limit = np.log(options.prune_size * extent if limited else np.finfo(float).max)
            self.is_small = self.largest <= np.log(np.float64(options.split_size * extent))
            least = np.float64(options.prune_opacity)
            logit = np.log(least) - np.log1p(-least)
        # false for NaN too
        self.visible: NDArray[np.bool_] = rows["opacity_logits"] >= logit
        if "anchors" in rows:
            self.visible &= ~outside(rows["positions"], rows["anchors"], rows["max_offsets"],
                                     options.sphere_reach)

    @property
    def prunes(self) -> NDArray[np.bool_]:
        """bool[N]: transparent, outside its sphere or too large."""
        stays: NDArray[np.bool_] = self.visible & (self.largest <= self.limit)
        return ~stays


def plan_growth(candidates: Candidates, grows: NDArray[np.bool_], prunes: NDArray[np.bool_],
                rng: np.random.Generator) -> Growth:
    """Decide what becomes of each gaussian.

    Parameters
    ----------
    candidates : the gaussians.
    grows : bool[N], those to be cloned or split.
    prunes : bool[N], those to be removed; one that is too large may still be split, if its children
        are small enough.
    rng : draws the positions of children.
    """
    rows, options = candidates.rows, candidates.options
    splits = np.flatnonzero(grows & ~candidates.is_small)
    clones = np.flatnonzero(grows & candidates.is_small & ~prunes)
    children = np.repeat(splits, CHILDREN)
    # drawn for every child, so that pruning one does not change the position of another
    log_scales = rows["log_scales"][children].astype(np.float64)
    offsets = _rotated(rows["quaternions"][children],
                       rng.standard_normal((len(children), 3)) * np.exp(log_scales))
    positions = (rows["positions"][children] + offsets).astype(np.float32)
    # a parent that is pruned only for its size may have children
    lives = (candidates.visible | ~prunes) & (candidates.largest - SHRINK <= candidates.limit)
    keeps = lives[children]
    spheres: dict[str, NDArray[np.float32]] = {}
    if "anchors" in rows:
        parents = {name: rows[name][children] for name in ("anchors", "max_offsets")}
        anchors, max_offsets = sphere_children(parents, positions, options)
        keeps &= ~outside(positions, anchors, max_offsets, options.sphere_reach)
        spheres = {"anchors": anchors[keeps], "max_offsets": max_offsets[keeps]}

    stays_mask = ~prunes
    stays_mask[splits] = False
    stays = np.flatnonzero(stays_mask)
    first = len(stays) + len(clones)
    of_children = {
        "positions": positions[keeps],
        "log_scales": (log_scales[keeps] - SHRINK).astype(np.float32), **spheres}
    changes = {name: (first, values) for name, values in of_children.items()}
    if spheres:  # a clone is anchored at its own position
        anchors = np.concatenate([rows["positions"][clones], spheres["anchors"]])
        changes["anchors"] = len(stays), anchors.astype(np.float32)
    source = np.concatenate([stays, clones, children[keeps]]).astype(np.uint32)
    split = int(keeps.reshape(-1, CHILDREN).any(axis=1).sum())
    return Growth(source, len(stays), len(clones), split,
                  len(rows["positions"]) - len(stays) - split, changes)


def _rotated(quaternions: NDArray[np.float32], vectors: NDArray[np.float64]
             ) -> NDArray[np.float64]:
    """Vectors [N, 3] rotated by quaternions [N, 4], wxyz, of any length."""
    q = quaternions.astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-30)
    axis = q[:, 1:]
    twice = 2 * np.cross(axis, vectors)
    return vectors + q[:, :1] * twice + np.cross(axis, twice)
