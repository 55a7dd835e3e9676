"""Which views see a cell, by the tracks of the sparse model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from clsplat.partition.input import PartitionInput
    from clsplat.partition.region import Region

LEAST_OF_VIEW = 0.3  # share of a view's points above which a cell is assigned the view
LEAST_OF_CELL = 0.1  # share of a cell's points above which a view is assigned to the cell


def seen_by_tracks(data: PartitionInput, regions: Sequence[Region]) -> NDArray[np.bool_]:
    """Which views see each region, as bool[B, V] (SunshineWYC, BlockGaussian 2025).

    A view sees a region if more than 0.3 of the view's points lie in the region, or if more than
    0.1 of the region's points are in the view.
    """
    sees = np.zeros((len(regions), len(data.views)), bool)
    of_view = np.bincount(data.observed_views, minlength=len(data.views))
    coordinates = regions[0].space.to(data.points)
    for block, region in enumerate(regions):
        inside = region.holds(coordinates)
        shared = np.bincount(data.observed_views[inside[data.observed_points]],
                             minlength=len(data.views))
        sees[block] = (shared > LEAST_OF_VIEW * of_view) | (shared > LEAST_OF_CELL * inside.sum())
    return sees
