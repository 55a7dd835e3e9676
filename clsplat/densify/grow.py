"""What becomes of gaussians in a round of growth, decided on the host.

Adaptive density control (Kerbl et al. 2023, section 5.2): of the gaussians chosen to grow, small
ones are cloned and large ones split in two. Those that are transparent, too large or outside their
sphere are pruned. Relocation (Kheradmand et al. 2024): a dead gaussian becomes a copy of a live
one, drawn with probability in proportion to opacity, and so does each new gaussian. The copies and
the gaussian itself share what it contributed: their opacity and size are chosen so that the sum
looks as it did (eq. 9).

Decisions are made with numpy from a few numbers of each gaussian; the rows themselves are moved on
the device.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.sphere import outside

if TYPE_CHECKING:
    from clsplat.densify.round import Round

SPLIT_SHRINK = 1.6
SHRINK = np.log(SPLIT_SHRINK)
CHILDREN = 2
STEP, REACH = 0.25, 8.0  # of the sum for an integral, standard deviations; its error is below 1e-12
OPACITY_MAX = 1 - 2.0**-20  # the logit of 1 is infinite

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Growth:
    """How a round of growth makes M new rows from N old ones."""

    # uint32[M], the old row of each new row: first the rows that stay, then clones, then the
    # children of splits; or after those that stay all that share in a relocation
    source: NDArray[np.uint32]
    kept: int  # how many rows stay, with their moments
    cloned: int  # how many rows are cloned
    split: int  # how many rows are replaced by their children
    pruned: int  # how many rows are removed without children
    # field name -> (first new row, values), where new rows differ from their source
    changes: dict[str, tuple[int, NDArray[np.float32]]]

    @property
    def unchanged(self) -> int:
        """How many new rows, from the first one on, are equal to their source."""
        return min((first for first, _ in self.changes.values()), default=len(self.source))


def plan_growth(round: Round, grows: NDArray[np.bool_], prunes: NDArray[np.bool_]) -> Growth:
    """Decide what becomes of each gaussian: clone or split those of `grows`, bool[N], remove those
    of `prunes`, bool[N]. One that is too large may still be split, if its children are small
    enough."""
    rows, options = round.rows, round.options
    splits = np.flatnonzero(grows & ~round.is_small)
    clones = np.flatnonzero(grows & round.is_small & ~prunes)
    of_splits = {name: rows[name].take(splits, axis=0) for name in rows}
    # a parent that is pruned only for its size may have children
    lives = (round.visible[splits] | ~prunes[splits]) & (round.largest[splits] - SHRINK <= round.limit)
    keeps = np.repeat(lives, CHILDREN)
    quaternions = of_splits["quaternions"].astype(np.float64)[:, None]
    quaternions /= np.maximum(np.linalg.norm(quaternions, axis=2, keepdims=True), 1e-30)
    w, axis = quaternions[..., :1], quaternions[..., 1:]
    # drawn for every child, so that pruning one does not change the position of another
    drawn = (
        round.rng.standard_normal((len(splits), CHILDREN, 3))
        * np.exp(of_splits["log_scales"].astype(np.float64))[:, None]
    )
    twice = 2 * np.cross(axis, drawn)
    offsets = drawn + w * twice + np.cross(axis, twice)
    positions = (of_splits["positions"][:, None] + offsets).astype(np.float32).reshape(-1, 3)
    spheres: dict[str, NDArray[np.float32]] = {}
    if "anchors" in rows:
        anchors = positions if options.sphere_rule == "release" else np.repeat(of_splits["anchors"], CHILDREN, axis=0)
        max_offsets = (np.repeat(of_splits["max_offsets"], CHILDREN) * options.sphere_shrink).astype(np.float32)
        keeps &= ~outside(positions, anchors, max_offsets, options.sphere_reach)
        spheres = {"anchors": anchors, "max_offsets": max_offsets}

    stays_mask = ~prunes
    stays_mask[splits] = False
    stays = np.flatnonzero(stays_mask)
    first = len(stays) + len(clones)
    kept = np.flatnonzero(keeps)
    parent = kept // CHILDREN  # among the splits
    changes = {name: (first, values.take(kept, axis=0)) for name, values in {"positions": positions, **spheres}.items()}
    changes["log_scales"] = first, (of_splits["log_scales"] - SHRINK).astype(np.float32).take(parent, axis=0)
    if spheres:  # a clone is anchored at its own position
        anchors = np.concatenate([rows["positions"][clones], changes["anchors"][1]])
        changes["anchors"] = len(stays), anchors.astype(np.float32)
    source = np.concatenate([stays, clones, splits[parent]], dtype=np.uint32, casting="unsafe")
    split = int(np.count_nonzero(np.bincount(parent)))
    return Growth(source, len(stays), len(clones), split, len(rows["positions"]) - len(stays) - split, changes)


def plan_relocation(
    opacity_logits: NDArray[np.floating],
    log_scales: NDArray[np.floating],
    dead: NDArray[np.bool_],
    frozen: NDArray[np.bool_],
    added: int,
    least_opacity: float,
    rng: np.random.Generator,
) -> Growth:
    """Decide which gaussians become copies of which, in one draw for relocation and growth.

    Where no gaussian lives nothing changes. The moments of all gaussians that share begin at 0.
    Those of `dead`, bool[N], are relocated; those of `frozen` do not change and are not drawn; the
    model grows by `added`; no copy gets less than `least_opacity`.
    """
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-opacity_logits.astype(np.float64)))
    moves = dead & ~frozen
    cumulative = np.cumsum(np.where(dead | frozen, 0.0, opacities))
    copies, lives = int(moves.sum()) + added, bool(cumulative[-1] > 0)
    if not (copies and lives):
        return Growth(np.arange(len(dead), dtype=np.uint32), len(dead), 0, 0, 0, {})
    # 1 - random() is never 0, so that none is drawn that has no share
    drawn = np.searchsorted(cumulative, (1 - rng.random(copies)) * cumulative[-1])
    times = np.bincount(drawn, minlength=len(dead))
    parents = np.flatnonzero(times)
    sharing = np.concatenate([parents, np.repeat(parents, times[parents])])
    opacity, shrink = shared(opacities[parents], times[parents] + 1)
    opacity = np.clip(opacity, least_opacity, OPACITY_MAX)
    stays = np.flatnonzero(~moves & (times == 0))

    def of_sharing(values: Floats) -> Floats:
        return np.concatenate([values, np.repeat(values, times[parents], axis=0)])

    logits = of_sharing(np.log(opacity) - np.log1p(-opacity))
    scales = log_scales[sharing] + of_sharing(np.log(shrink))[:, None]
    return Growth(
        np.concatenate([stays, sharing]).astype(np.uint32),
        len(stays),
        copies,
        0,
        int(moves.sum()),
        {
            "opacity_logits": (len(stays), logits.astype(np.float32)),
            "log_scales": (len(stays), scales.astype(np.float32)),
        },
    )


def shared(opacity: Floats, number: NDArray[np.integer]) -> tuple[Floats, Floats]:
    """The opacity o' of each of N equal gaussians in place of one, and the factor of their size.

    Stacked in one place they are as opaque in their middle as the one was, 1 - (1 - o')^N = o, and
    along a line across it the integral of their opacity is the same:

        o sqrt(2 pi) s = s' integral of 1 - (1 - o' exp(-x^2 / 2))^N

    The binomial theorem makes of this the double sum of eq. 9, whose terms alternate and cancel;
    the integral has no such terms, for any N. All are [S]; `opacity` is above 0, `number` (N) too.
    """
    with np.errstate(divide="ignore"):  # an opacity of 1
        each = -np.expm1(np.log1p(-opacity) / number)
        total = np.zeros(len(opacity))
        for x in np.arange(0.0, REACH + STEP, STEP):  # the trapezoidal rule, for half of the line
            weight = STEP if x else STEP / 2
            total -= weight * np.expm1(number * np.log1p(-each * np.exp(-x * x / 2)))
    return each, opacity * np.sqrt(np.pi / 2) / total
