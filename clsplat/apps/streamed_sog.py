"""Streamed SOG, version 1: a model as chunks with levels of detail, which PlayCanvas loads by need.

A balanced tree cuts the model into leaves. Level 0 has all gaussians of a leaf, and each further
one a quarter of those before, merged. Chunks are unpacked SOG, in which a leaf has a range: of
coarse levels, several leaves share a chunk, so that files are neither small nor many.

All chunks have the model's local coordinates, in single precision: `origin` in the index, which
viewers leave out, leads from there to the original ones.
"""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.models import VIEWERS_UP, turned_up
from clsplat.apps.tiles import corners
from clsplat.edit.decimate import decimated
from clsplat.edit.select import halves, merged, selected
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.folders import new_folder
from clsplat.io.models.sog import sog_files
from clsplat.io.models.values import Notes, mode_comment, morton_order
from clsplat.io.records import write_object

INDEX = "lod-meta.json"
CHUNK_GAUSSIANS = 65_536  # of a leaf at most, and of a chunk, until a leaf more makes it larger
SHARE = 4  # gaussians of a level for one of the next: at twice the distance
MOST_LEVELS, LEAST_GAUSSIANS = 5, 64  # of a leaf's coarsest level, at least
Node = dict[str, Any]


def write_run_sog(
    folder: Path, run: Run, gaussians: Gaussians, upright: bool, progress: Callable[[int, int], object]
) -> int:
    """Write the finished model of a run, or some of its gaussians, as Streamed SOG into a new or
    empty folder, which appears as a whole; otherwise as `write_streamed_sog`."""
    if upright:
        gaussians = turned_up(gaussians, run.up, VIEWERS_UP)
    with new_folder(folder) as partial:
        return write_streamed_sog(partial, gaussians, (mode_comment(run.options.antialiased),), progress=progress)


def write_streamed_sog(
    folder: Path,
    gaussians: Gaussians,
    comments: tuple[str, ...] = (),
    limit: int = CHUNK_GAUSSIANS,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> int:
    """Write the index and a folder for each chunk into an existing folder.

    Parameters
    ----------
    gaussians : the model, not empty.
    comments : lines of text, of which SOG has a place for some.
    limit : see CHUNK_GAUSSIANS.
    progress : called with the number of leaves that are done, and of all.

    Returns
    -------
    How many chunks there are.
    """
    threads, notes = os.cpu_count() or 1, Notes(comments)
    leaves: list[tuple[NDArray[np.intp], Node]] = []
    tree = _node(gaussians.positions.astype(np.float64), np.arange(gaussians.count), limit, leaves)
    largest = max(len(rows) for rows, _ in leaves)
    levels = 1
    while levels < MOST_LEVELS and largest // SHARE**levels >= LEAST_GAUSSIANS:
        levels += 1

    def all_levels(rows: NDArray[np.intp]) -> list[Gaussians]:
        finest = selected(gaussians, rows).located(np.zeros(3))
        found = [finest]
        for _ in range(1, levels):
            found.append(decimated(found[-1], -(-found[-1].count // SHARE)))
        return [selected(each, morton_order(each.positions)) for each in found]

    # of each level, the parts of the next chunk and the numbers of their leaves
    open_chunks: list[list[tuple[Gaussians, Node]]] = [[] for _ in range(levels)]
    counts, filenames = levels * [0], list[str]()

    def chunk(level: int) -> tuple[str, Gaussians]:
        """Close the chunk of a level: its folder, and what it holds."""
        name, parts = f"{level}_{len(filenames)}", open_chunks[level]
        offset = 0
        for part, leaf in parts:
            leaf["lods"][str(level)] = {"file": len(filenames), "offset": offset, "count": part.count}
            offset += part.count
        counts[level] += offset
        filenames.append(f"{name}/meta.json")
        open_chunks[level] = []
        return name, merged([part for part, _ in parts])

    def chunks() -> Iterator[tuple[str, Gaussians]]:
        found = called_ahead(all_levels, ((rows,) for rows, _ in leaves), threads, threads)
        for done, (of_levels, (_, leaf)) in enumerate(zip(found, leaves), 1):
            progress(done, len(leaves))
            low, high = corners(of_levels[0])
            leaf |= {"bound": {"min": low.tolist(), "max": high.tolist()}, "lods": {}}
            for level, part in enumerate(of_levels):
                open_chunks[level].append((part, leaf))
                if sum(each.count for each, _ in open_chunks[level]) + part.count > limit:
                    yield chunk(level)
        for level in range(levels):
            if open_chunks[level]:
                yield chunk(level)

    def write(name: str, part: Gaussians) -> None:
        (folder / name).mkdir()
        for file, content in sog_files(part, notes, along_curve=False):
            (folder / name / file).write_bytes(content)

    for _ in called_ahead(write, chunks(), threads, threads):
        pass  # an error is raised here
    _bound(tree)
    write_object(
        folder / INDEX,
        {
            "version": 1,
            "asset": {"generator": "clsplat"},
            "origin": gaussians.offset.tolist(),
            "count": sum(counts),
            "counts": counts,
            "lodLevels": levels,
            "filenames": filenames,
            "tree": tree,
        },
    )
    return len(filenames)


def _node(
    positions: NDArray[np.float64], rows: NDArray[np.intp], limit: int, leaves: list[tuple[NDArray[np.intp], Node]]
) -> Node:
    """The tree below some rows, whose leaves are added to `leaves` in its order."""
    node: Node = {}
    if len(rows) <= limit:
        leaves.append((rows, node))
    else:
        node["children"] = [_node(positions, part, limit, leaves) for part in halves(positions, rows)]
    return node


def _bound(node: Node) -> Node:
    """Give nodes above leaves the box around those below; returns that of this one."""
    if "children" in node:
        below = [_bound(child) for child in node["children"]]
        node["bound"] = {
            "min": np.min([each["min"] for each in below], axis=0).tolist(),
            "max": np.max([each["max"] for each in below], axis=0).tolist(),
        }
    bound: Node = node["bound"]
    return bound
