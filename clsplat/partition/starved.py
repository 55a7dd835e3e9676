"""Blocks that have too little to be trained: refused, or joined to a neighbour."""

from dataclasses import replace

import numpy as np

from clsplat.errors import InputError
from clsplat.partition.partition import Cells


def refuse_starved(site, options, grid, regions, sees):
    """InputError if a block has fewer views or less content than it wants."""
    counts = _counts(site, regions)
    starved = np.flatnonzero(_starved(options, counts, sees))
    if len(starved):
        first = starved[0]
        others = f" (and {len(starved) - 1} more)" if len(starved) > 1 else ""
        raise InputError(
            f"{site.scene.name}: block {first}{others} of the {grid[0]}x{grid[1]} grid is starved: "
            f"{_what(counts[first], sees[first])}, wants {options.least_gaussians:,} and "
            f"{options.least_views}; use a smaller --grid, or --starved join")


def join_starved(site, options, regions, sees):
    """(regions, sees, notes): starved blocks joined one by one, the poorest first, to the poorest
    neighbour with which they make a box; the blocks keep their order."""
    regions, counts, sees = list(regions), _counts(site, regions).tolist(), list(sees)
    notes, given_up = [], []
    while len(regions) > 1:
        starved = [block for block in np.flatnonzero(_starved(options, counts, np.array(sees)))
                   if regions[block] not in given_up]
        if not starved:
            break
        poor = min(starved, key=lambda block: counts[block])
        unions = {other: union for other, region in enumerate(regions)
                  if (union := _union(regions[poor], region)) is not None}
        what = _what(counts[poor], sees[poor])
        if not unions:
            notes.append(f"a block stays starved, no neighbour makes a box with it: {what}")
            given_up.append(regions[poor])
            continue
        other = min(unions, key=lambda block: counts[block])
        first, last = sorted((poor, other))
        regions[first] = unions[other]
        counts[first] += counts.pop(last)
        sees[first] = sees[first] | sees.pop(last)
        del regions[last]
        notes.append(f"a starved block was joined to its neighbour: {what}")
    return regions, np.array(sees), notes


def _counts(site, regions):
    """Content of each block."""
    owner = Cells(regions).at(regions[0].space.to(site.content))
    return np.bincount(owner[owner >= 0], minlength=len(regions))


def _starved(options, counts, sees):
    return ((np.array(counts) < options.least_gaussians)
            | (sees.sum(axis=1) < options.least_views))


def _what(count, seen):
    return f"{count:,} gaussians and {seen.sum()} views"


def _union(a, b):
    """The Region of two that share a whole face; None of two that do not."""
    same = (a.low == b.low) & (a.high == b.high)
    if same.sum() != 2:
        return None
    axis = int(np.argmin(same))
    if a.high[axis] != b.low[axis] and b.high[axis] != a.low[axis]:
        return None
    return replace(a, low=np.minimum(a.low, b.low), high=np.maximum(a.high, b.high))
