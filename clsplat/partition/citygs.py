"""A grid in contracted space; a cell is assigned the views that change without its gaussians (Liu
et al. 2024, CityGaussian, section 3.2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.partition.clusters import Clusters
from clsplat.partition.input import CONTENT_QUANTILES
from clsplat.partition.partition import Cells
from clsplat.partition.region import Region
from clsplat.partition.tracks import seen_by_tracks

if TYPE_CHECKING:
    from clsplat.partition.input import PartitionInput
    from clsplat.partition.make import DropTest
    from clsplat.partition.options import PartitionOptions
    from clsplat.partition.region import Space

TESTED_GAUSSIANS = 25_000  # a cell with fewer, and fewer than an equal share, is enlarged to test
GROWTH_STEP = 0.01  # of contracted space, by which such a cell is enlarged
IMAGE_MARGIN = 0.1  # of the image: gaussians with a centre this far outside may still be visible


def citygs(data: PartitionInput, grid: tuple[int, int], options: PartitionOptions,
           drop: DropTest | None = None) -> tuple[list[Region], NDArray[np.bool_]]:
    """Cut the scene into the cells of a uniform N x M grid along u and v, row by row.

    A view is assigned to the cell that contains its camera, and to those without whose gaussians
    `drop` is more than `options.threshold`. `drop` receives all cells of a view in turn, so that a
    view's full render is needed once. Where it is None, the tracks of the view decide
    (`seen_by_tracks`).

    Returns
    -------
    The regions, and bool[B, V]: which views are assigned to each.
    """
    space = _contracted(data, grid)
    margin = options.margin
    across, along = (_ends(n) for n in grid)
    regions = [Region(space, np.array([u0, v0, -np.inf]), np.array([u1, v1, np.inf]), margin)
               for v0, v1 in zip(along, along[1:]) for u0, u1 in zip(across, across[1:])]
    cameras = space.to(data.cameras)
    assigned = np.array([region.holds(cameras) for region in regions])
    if len(regions) == 1:
        return regions, assigned
    if drop is None:
        return regions, assigned | seen_by_tracks(data, regions)
    content = space.to(data.content)
    tested = _tested(regions, content)
    owner = Cells(regions).at(content)
    pairs: list[tuple[int, int]] = []  # block, view
    for view, visible in enumerate(_visible_cells(data, owner)):
        pairs += [(block, view) for block in visible[~assigned[visible, view]].tolist()]
    inside = [np.flatnonzero(region.holds(content)) for region in tested]
    changes = drop((int(data.views[view]), _all_but(inside[block], len(content)))
                   for block, view in pairs)
    for (block, view), change in zip(pairs, changes):
        assigned[block, view] = change > options.threshold
    return regions, assigned


def _contracted(data: PartitionInput, grid: tuple[int, int]) -> Space:
    """The contracted space of the grid.

    Its area of interest is the bounds that the user set. Otherwise the area is chosen so that each
    of the outermost cells contains 1/N of the content, since cells of equal size in contracted
    space differ in content: it is the middle half of the content for up to four cells along an
    axis, less for more cells, and all of it along an axis that is not cut.
    """
    outside = [1 / max(n, 4) for n in grid]
    shares = [(share, 1 - share) if n > 1 else CONTENT_QUANTILES
              for share, n in zip(outside, grid)]
    # cell 1 of N > 3 begins at 1/N of contracted space, N/4 half sides from the middle
    return data.space(contracted=True, shares=shares, stretch=[4 * share for share in outside])


def _ends(count: int) -> list[float]:
    """The ends of `count` cells along an axis; the outermost cells are unbounded."""
    return [-np.inf, *(np.arange(1, count) / count), np.inf]


def _tested(regions: Sequence[Region], content: NDArray[np.float64]) -> list[Region]:
    """The Regions, enlarged on all sides alike, in steps, until they contain enough content."""
    enough = min(TESTED_GAUSSIANS, len(content) // len(regions))
    tested = []
    for region in regions:
        away = np.fmax(region.low - content, content - region.high).max(axis=1).clip(0)
        needed = np.partition(away, enough - 1)[enough - 1] if enough else 0
        growth = GROWTH_STEP * (np.floor(needed / GROWTH_STEP) + 1) if needed else 0
        tested.append(Region(region.space, region.low - growth, region.high + growth))
    return tested


def _visible_cells(data: PartitionInput, owner: NDArray[np.integer]
                   ) -> Iterator[NDArray[np.integer]]:
    """For each view, the cells that have content in its image or close beside it.

    Parameters
    ----------
    owner : [M], the cell of each content, -1 for none.
    """
    places = (data.content - data.scene.offset) / data.scene.unit
    clusters = Clusters(places, np.zeros(len(places)))
    places, owner = places[clusters.order], owner[clusters.order]
    for index in data.views:
        camera = data.scene.views[index].camera
        beside_x, beside_y = IMAGE_MARGIN * camera.width, IMAGE_MARGIN * camera.height
        near = clusters.near_view(camera, 0.0, max(beside_x, beside_y))
        (x, y), depth = (each.T for each in camera.project(places[near]))
        shown = ((depth > 0) & (x > -beside_x) & (x < camera.width + beside_x)
                 & (y > -beside_y) & (y < camera.height + beside_y))
        yield np.flatnonzero(np.bincount(owner[near[shown]] + 1)[1:])


def _all_but(indices: NDArray[np.integer], count: int) -> NDArray[np.bool_]:
    """bool[count], false at these indices."""
    others = np.ones(count, bool)
    others[indices] = False
    return others
