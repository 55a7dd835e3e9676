"""The merged model of a city as a tree of levels of detail, made block by block.

A block is halved across its longest side, again and again, until no part has more than CELL
gaussians: these are the leaves. Four of them, or of the nodes above, are replaced by a quarter as
many gaussians, which `decimated` merges; the tops of the blocks likewise. So host memory holds one
block, and of the others only their tops.
"""

from __future__ import annotations

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
            self._tops.append(self._below(block, np.arange(block.count)))

    def finish(self) -> None:
        """Write the nodes above the blocks; the last one is the root."""
        if self._tops:
            nodes = np.stack([self._writer.nodes[number] for number, _ in self._tops])
            self._above((nodes["usual_low"] + nodes["usual_high"]) / 2, np.arange(len(nodes)))

    def _below(self, block: Gaussians, rows: NDArray[np.intp]) -> Node:
        if len(rows) <= self._cell:
            content = selected(block, rows)
            return self._writer.add(content, facts_of(content)), content
        return self._joined([self._below(block, part) for part in parted(
            block.positions, rows, self._cell, ROUNDS)])

    def _above(self, middles: NDArray[np.float64], rows: NDArray[np.intp]) -> Node:
        if len(rows) == 1:
            return self._tops[int(rows[0])]
        return self._joined([self._above(middles, part)
                             for part in parted(middles, rows, 1, ROUNDS)])

    def _joined(self, children: list[Node]) -> Node:
        numbers = [number for number, _ in children]
        whole = merged([content for _, content in children])
        content = decimated(whole, -(-whole.count // FEWER))
        below = np.stack([self._writer.nodes[number] for number in numbers])
        facts = facts_of(content)
        for name, end in (("low", np.minimum), ("usual_low", np.minimum), ("high", np.maximum),
                          ("usual_high", np.maximum), ("largest", np.maximum)):
            facts[name] = end(facts[name], end.reduce(below[name]))
        return self._writer.add(content, facts, numbers), content


def facts_of(content: Gaussians) -> dict[str, ArrayLike]:
    """The index entry of a tree's node, which has one gaussian at least (io/models/tree.py)."""
    positions = content.positions.astype(np.float64)
    usual = np.quantile(positions, (TAIL_SHARE, 1 - TAIL_SHARE), axis=0)
    return {"low": positions.min(axis=0), "high": positions.max(axis=0), "usual_low": usual[0],
            "usual_high": usual[1], "largest": np.exp(float(content.log_scales.max())),
            "sigma": mean_sigma(content)}
