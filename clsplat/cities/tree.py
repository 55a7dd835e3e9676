"""The merged model of a city as a tree of levels of detail, made block by block.

A block is halved across its longest side, again and again, until no part has more than CELL
gaussians: these are the leaves. Four of them, or of the nodes above, are replaced by a quarter as
many gaussians, which `decimated` merges; the tops of the blocks likewise. So host memory holds one
block, and of the others only what is known of their tops.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from clsplat.cities.merge import Merged, merge
from clsplat.edit.decimate import decimated
from clsplat.edit.select import TAIL_SHARE, halves, merged, selected
from clsplat.gaussians import Gaussians
from clsplat.io.models.tree import TreeWriter, writing_tree
from clsplat.io.runs.city import CityFolder
from clsplat.scene import Scene

CELL = 2048  # gaussians of a leaf at most
FANOUT = 4  # nodes that one above replaces, at most, and how many times fewer gaussians it has
LEAST = 1e-30  # frequency, where all gaussians are transparent
Node = tuple[int, Gaussians]  # its number and its content


@dataclass
class TreeBuilder:
    """Builds a tree from blocks, which are added one after the other; `cell`: gaussians of a leaf
    at most."""

    writer: TreeWriter
    cell: int = CELL
    _tops: list[int] = field(default_factory=list)

    def add(self, block: Gaussians) -> None:
        """Write the nodes of a block; nothing for one without gaussians."""
        if block.count:
            number, _ = self._below(block, np.arange(block.count))
            self._tops.append(number)

    def finish(self) -> None:
        """Write the nodes above the blocks; the last one is the root."""
        tops = np.array(self._tops, np.intp)
        middles = np.array([(self.writer.nodes[top]["usual_low"] + self.writer.nodes[
            top]["usual_high"]) / 2 for top in tops]).reshape(-1, 3)

        def above(rows: NDArray[np.intp]) -> Node:
            if len(rows) == 1:
                top = int(tops[rows[0]])
                return top, self.writer.read(top)
            return self._joined([above(part) for part in parted(middles, rows, 1)])

        if len(tops):
            above(np.arange(len(tops)))

    def _below(self, block: Gaussians, rows: NDArray[np.intp]) -> Node:
        if len(rows) <= self.cell:
            content = selected(block, rows)
            return self.writer.add(content, facts_of(content)), content
        return self._joined([self._below(block, part)
                             for part in parted(block.positions, rows, self.cell)])

    def _joined(self, children: list[Node]) -> Node:
        numbers = [number for number, _ in children]
        whole = merged([content for _, content in children])
        content = decimated(whole, -(-whole.count // FANOUT))
        facts, below = facts_of(content), [self.writer.nodes[number] for number in numbers]
        for names, end in ((("low", "usual_low"), np.min), (("high", "usual_high"), np.max),
                           (("largest",), np.max)):
            for name in names:
                facts[name] = end([facts[name], *(node[name] for node in below)], axis=0)
        return self.writer.add(content, facts, numbers), content


def frequency(log_scales: NDArray[np.floating], opacity_logits: NDArray[np.floating]) -> float:
    """The `robust_mean` of training/frequency.py, on the host, in 1 / world unit; 0 without rows.
    """
    opacity = expit(opacity_logits.astype(np.float64))
    sigma = np.exp(log_scales.astype(np.float64)).mean(axis=1)
    return float(opacity.sum() / max(opacity @ sigma, np.finfo(float).tiny))


def facts_of(content: Gaussians) -> dict[str, Any]:
    """The index entry of a tree's node, which has one gaussian at least (io/models/tree.py)."""
    positions = content.positions.astype(np.float64)
    usual = np.quantile(positions, (TAIL_SHARE, 1 - TAIL_SHARE), axis=0)
    return {"low": positions.min(axis=0), "high": positions.max(axis=0), "usual_low": usual[0],
            "usual_high": usual[1], "largest": np.exp(float(content.log_scales.max())),
            "sigma": 1 / max(frequency(content.log_scales, content.opacity_logits), LEAST)}


def parted(positions: NDArray[np.floating], rows: NDArray[np.intp], most: int
           ) -> Iterator[NDArray[np.intp]]:
    """Divide rows, more than `most`, into two to FANOUT parts, each with its rows ascending.

    Parts of more than `most` rows are halved across the longest side of most of their positions.
    """
    parts = [rows]
    while len(parts) < FANOUT:
        smaller = [half for part in parts for half in (
            halves(positions, part) if len(part) > most else (part,))]
        if len(smaller) == len(parts):
            break
        parts = smaller
    yield from parts


def merge_tree(path: Path, city: CityFolder, scene: Scene, sh_degree: int, fill: bool = False
               ) -> Merged:
    """Merge the finished blocks of a city into a tree, and return what `merge` does.

    The file is replaced as a whole; other arguments and errors as for `merge` and `Merged.check`.
    """
    with writing_tree(path, sh_degree, scene.offset) as writer:
        builder = TreeBuilder(writer)
        result = merge(city, scene, fill, builder.add)
        result.check()
        builder.finish()
    return result
