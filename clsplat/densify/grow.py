"""Adaptive density control of 3DGS (Kerbl et al. 2023, section 5.2), decided on the host.

Of the gaussians chosen to grow, small ones are cloned and large ones split in two. Those that are
transparent, too large or outside their sphere are pruned. Decisions are made with numpy from a few
numbers of each gaussian; the rows themselves are moved on the device.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.sphere import children as sphere_children
from clsplat.densify.sphere import outside
from clsplat.schedule.growth import Growth

if TYPE_CHECKING:
    from clsplat.densify.options import GrowthOptions

SPLIT_SIZE = 0.01  # share of the scene extent; larger gaussians are split, smaller ones cloned
SPLIT_SHRINK = 1.6
SHRINK = np.log(SPLIT_SHRINK)
CHILDREN = 2


class Candidates:
    """What growth knows of N gaussians.

    Parameters
    ----------
    rows : field name -> float32[N, *row shape], every field but the spherical harmonics (SH).
    extent : of the scene, world units.
    options, prunes_large : of the training; whether ones larger than `prune_size` are removed.

    Attributes
    ----------
    largest : float32[N], the largest of the three logarithms of standard deviations, world units.
    limit : the logarithm of the largest standard deviation that is not pruned.
    is_small, visible : bool[N], cloned rather than split; neither transparent nor outside a sphere.
    """

    def __init__(self, rows: dict[str, NDArray[np.float32]], extent: float, options: GrowthOptions,
                 prunes_large: bool) -> None:
        self.rows, self.options = rows, options
        # thresholds are taken to logarithms and logits rather than all rows from them
        x, y, z = rows["log_scales"].T
        self.largest = np.maximum(np.maximum(x, y), z)  # thirty times as fast as a reduction
        limited = prunes_large and options.prune_size > 0
        with np.errstate(divide="ignore"):  # a threshold of 0 or 1 is infinite
            self.limit = np.log(options.prune_size * extent if limited else np.finfo(float).max)
            self.is_small = self.largest <= np.log(np.float64(SPLIT_SIZE * extent))
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
    """Decide what becomes of each gaussian: clone or split those of `grows`, bool[N], remove those
    of `prunes`, bool[N]. One that is too large may still be split, if its children are small
    enough."""
    rows, options = candidates.rows, candidates.options
    splits = np.flatnonzero(grows & ~candidates.is_small)
    clones = np.flatnonzero(grows & candidates.is_small & ~prunes)
    of_splits = {name: rows[name].take(splits, axis=0) for name in rows}
    # a parent that is pruned only for its size may have children
    lives = ((candidates.visible[splits] | ~prunes[splits])
             & (candidates.largest[splits] - SHRINK <= candidates.limit))
    keeps = np.repeat(lives, CHILDREN)
    log_scales = _columns(of_splits["log_scales"])
    # drawn for every child, so that pruning one does not change the position of another
    drawn = rng.standard_normal((len(splits), CHILDREN, 3)).transpose(2, 1, 0).copy()
    offsets = _rotated(_columns(of_splits["quaternions"]), drawn * np.exp(log_scales)[:, None])
    positions = np.ascontiguousarray(
        (_columns(of_splits["positions"])[:, None] + offsets).astype(np.float32).transpose(2, 1, 0)
        ).reshape(-1, 3)
    spheres: dict[str, NDArray[np.float32]] = {}
    if "anchors" in rows:
        parents = {name: np.repeat(of_splits[name], CHILDREN, axis=0)
                   for name in ("anchors", "max_offsets")}
        anchors, max_offsets = sphere_children(parents, positions, options)
        keeps &= ~outside(positions, anchors, max_offsets, options.sphere_reach)
        spheres = {"anchors": anchors, "max_offsets": max_offsets}

    stays_mask = ~prunes
    stays_mask[splits] = False
    stays = np.flatnonzero(stays_mask)
    first = len(stays) + len(clones)
    kept = np.flatnonzero(keeps)
    parent = kept // CHILDREN  # among the splits
    changes = {name: (first, values.take(kept, axis=0))
               for name, values in {"positions": positions, **spheres}.items()}
    changes["log_scales"] = first, (of_splits["log_scales"] - SHRINK).astype(np.float32).take(
        parent, axis=0)
    if spheres:  # a clone is anchored at its own position
        anchors = np.concatenate([rows["positions"][clones], changes["anchors"][1]])
        changes["anchors"] = len(stays), anchors.astype(np.float32)
    source = np.concatenate([stays, clones, splits[parent]], dtype=np.uint32, casting="unsafe")
    split = int(np.count_nonzero(np.bincount(parent)))
    return Growth(source, len(stays), len(clones), split,
                  len(rows["positions"]) - len(stays) - split, changes)


def _columns(rows: NDArray[np.float32]) -> NDArray[np.float64]:
    """Rows [N, K] as columns [K, N]: numpy takes several times as long over a short last axis."""
    return rows.T.copy().astype(np.float64)


def _rotated(quaternions: NDArray[np.float64], vectors: NDArray[np.float64]
             ) -> NDArray[np.float64]:
    """Vectors [3, C, N] rotated by quaternions [4, N], wxyz, of any length."""
    w, x, y, z = quaternions
    length = np.sqrt(w * w + (x * x + y * y + z * z))
    w, *axis = quaternions / np.maximum(length, 1e-30)
    twice = [2 * part for part in _cross(axis, vectors)]
    return np.stack([part + w * along + across for part, along, across
                     in zip(vectors, twice, _cross(axis, twice))])


def _cross(a: Iterable[NDArray[np.float64]], b: Iterable[NDArray[np.float64]]
           ) -> list[NDArray[np.float64]]:
    """The components of a cross product, from those of its factors."""
    (ax, ay, az), (bx, by, bz) = a, b
    return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
