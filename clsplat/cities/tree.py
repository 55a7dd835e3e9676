"""The merged model of a city as a tree of levels of detail, made block by block.

A block is halved across its longest side, again and again, until no part has more than CELL
gaussians: these are the leaves. Four of them, or of the nodes above, are replaced by a quarter as
many gaussians, which `decimated` merges; the tops of the blocks likewise. So host memory holds one
block, and of the others only their tops.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.edit.decimate import decimated
from clsplat.edit.select import TAIL_SHARE, mean_sigma, merged, parted, selected
from clsplat.gaussians import Gaussians
from clsplat.io.models.tree import TreeWriter

CELL = 2048  # gaussians of a leaf at most
ROUNDS = 2  # of halving, after which a node above replaces four
FEWER = 4  # times fewer gaussians in it
Node = tuple[int, Gaussians]  # its number and its content


class TreeBuilder:
    """Builds a tree from blocks, which are added one after the other; `cell`: gaussians of a leaf
    at most."""

    def __init__(self, writer: TreeWriter, cell: int = CELL) -> None:
        self._writer, self._cell = writer, cell
        self._tops: list[Node] = []

    def add(self, block: Gaussians) -> None:
        """Write the nodes of a block; nothing for one without gaussians."""
        if block.count:
            self._tops.append(
                self._top(
                    block.positions, np.arange(block.count), self._cell, lambda rows: self._node(selected(block, rows))
                )
            )

    def finish(self) -> None:
        """Write the nodes above the blocks; the last one is the root."""
        if self._tops:
            nodes = np.stack([self._writer.nodes[number] for number, _ in self._tops])
            self._top(
                (nodes["usual_low"] + nodes["usual_high"]) / 2,
                np.arange(len(nodes)),
                1,
                lambda rows: self._tops[int(rows[0])],
            )

    def _top(
        self,
        positions: NDArray[np.floating],
        rows: NDArray[np.intp],
        most: int,
        leaf: Callable[[NDArray[np.intp]], Node],
    ) -> Node:
        """The node of some rows: a leaf of at most `most`, or one above the nodes of their parts."""
        if len(rows) <= most:
            return leaf(rows)
        numbers, contents = zip(
            *[self._top(positions, part, most, leaf) for part in parted(positions, rows, most, ROUNDS)]
        )
        whole = merged(contents)
        return self._node(decimated(whole, -(-whole.count // FEWER)), numbers)

    def _node(self, content: Gaussians, children: Sequence[int] = ()) -> Node:
        facts = facts_of(content)
        for below in (self._writer.nodes[child] for child in children):
            for name, end in (
                ("low", np.minimum),
                ("usual_low", np.minimum),
                ("high", np.maximum),
                ("usual_high", np.maximum),
                ("largest", np.maximum),
            ):
                facts[name] = end(facts[name], below[name])
        return self._writer.add(content, facts, children), content


def facts_of(content: Gaussians) -> dict[str, ArrayLike]:
    """The index entry of a tree's node, which has one gaussian at least (io/models/tree.py)."""
    positions = content.positions.astype(np.float64)
    usual = np.quantile(positions, (TAIL_SHARE, 1 - TAIL_SHARE), axis=0)
    return {
        "low": positions.min(axis=0),
        "high": positions.max(axis=0),
        "usual_low": usual[0],
        "usual_high": usual[1],
        "largest": np.exp(float(content.log_scales.max())),
        "sigma": mean_sigma(content),
    }
