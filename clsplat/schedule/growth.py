"""What a growth rule (`Schedule.grow`) is given, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


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

    @property
    def unchanged(self) -> int:
        """How many new rows, from the first one on, are equal to their source."""
        return min((first for first, _ in self.changes.values()), default=len(self.source))


class Round(Protocol):
    """A round of growth of N gaussians (densify/round.py).

    Attributes
    ----------
    iteration : number of the step before it, from 1.
    rows : field name -> float32[N, *row shape], every field but the spherical harmonics.
    frozen : bool[N], gaussians that are not trained; they stay.
    rng : draws; a resumed run draws the same numbers.
    """

    iteration: int
    rows: dict[str, NDArray[np.float32]]
    frozen: Mask
    rng: np.random.Generator

    @property
    def prunes(self) -> Mask:
        """bool[N], trained ones that are transparent, outside their sphere or too large."""

    @property
    def gradient(self) -> Floats:
        """float[N], mean screen gradients since the last round, NDC units; -inf for frozen ones."""

    @property
    def scores(self) -> Floats:
        """float[N], the scores of Taming 3DGS, at least 0."""

    def room(self, target: int | None, count: int) -> int | None:
        """How many gaussians may be added to `count` trained ones that stay, up to a `target` of
        trained ones; None: any number."""

    def above_threshold(self, room: int | None = None) -> Mask:
        """bool[N]: those whose gradient reaches `grow_threshold`, at most `room` (3DGS)."""

    def highest(self, room: int) -> Mask:
        """bool[N]: those of the highest gradients that stay (DashGaussian)."""

    def by_score(self, room: int, prunes: Mask) -> Mask:
        """bool[N]: those above the threshold, drawn by their scores (Taming 3DGS); none is one of
        `prunes`."""

    def half_of_prunes(self) -> Mask:
        """bool[N]: half of `prunes`, drawn by how low their scores are (Taming 3DGS)."""

    def densify(self, grows: Mask, prunes: Mask | None = None) -> Growth:
        """Clone the small ones among the gaussians that grow, and split the others in two.

        `grows` and `prunes` (None: those of the round) are bool[N]. One that is removed as too
        large may still be split, if its children are small enough.
        """

    def relocate(self, added: int) -> Growth:
        """Make copies of live gaussians, in place of transparent ones and, `added` of them, beside.
        """
