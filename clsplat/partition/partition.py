"""The result: which block owns which part of the world, and which views each block trains on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.partition.region import Region

if TYPE_CHECKING:
    from clsplat.partition.region import Space


class Cells:
    """A table of which of many Regions of one space contains a point; ValueError if two overlap.

    Attributes
    ----------
    edges : along each axis the ends of the cells, ascending.
    table : [edges + 1 along each axis]; the index of the cell between two edges, -1 for none.
    """

    def __init__(self, regions: Sequence[Region]) -> None:
        low, high = (np.array([getattr(region, name) for region in regions])
                     for name in ("low", "high"))
        self.edges = [np.unique(ends[np.isfinite(ends)])
                      for ends in np.concatenate([low, high]).T]
        first = [np.searchsorted(e, ends, side="right") for e, ends in zip(self.edges, low.T)]
        end = [np.searchsorted(e, ends, side="left") + 1 for e, ends in zip(self.edges, high.T)]
        self.table = np.full([len(e) + 1 for e in self.edges], -1, np.int32)
        for cell, ranges in enumerate(zip(*map(zip, first, end))):
            part = self.table[tuple(slice(*ends) for ends in ranges)]
            if (part >= 0).any():
                raise ValueError(f"blocks {part.max()} and {cell} overlap")
            part[...] = cell

    def at(self, coordinates: NDArray[np.float64]) -> NDArray[np.integer]:
        """The cell [N] at coordinates [N, 3] of the space; -1 where they are not finite."""
        place = tuple(np.searchsorted(e, column, side="right")
                      for e, column in zip(self.edges, coordinates.T))
        return np.where(np.isfinite(coordinates).all(axis=1), self.table[place], -1)


@dataclass(frozen=True, eq=False)
class Partition:
    """Which block owns which part of the world; ValueError for cells that overlap, leave gaps, or
    belong to different spaces.

    Attributes
    ----------
    method : the name of the method that made it.
    regions : the cell of each block.
    views : [K] for each block; indices into scene.views, ascending.
    dropped : for each view that no block is assigned, by its index, the reason.
    """

    method: str
    regions: tuple[Region, ...]
    views: tuple[NDArray[np.integer], ...]
    dropped: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.regions or len(self.regions) != len(self.views):
            raise ValueError(f"{len(self.regions)} regions and {len(self.views)} lists of views")
        spaces = {id(region.space): region.space.record() for region in self.regions}
        if any(space != self.space.record() for space in spaces.values()):
            raise ValueError("the blocks' spaces differ")
        if (self.cells.table < 0).any():
            raise ValueError("the blocks leave a gap")

    def check_views(self, count: int) -> None:
        """Raise ValueError for an index of a view that is not below `count`."""
        for index in (*self.dropped, *(int(i) for views in self.views for i in views)):
            if not 0 <= index < count:
                raise ValueError(f"view {index} of {count}")

    @property
    def space(self) -> Space:
        """The space of all cells."""
        return self.regions[0].space

    @cached_property
    def cells(self) -> Cells:
        """The table of the blocks' cells."""
        return Cells(self.regions)

    def owner(self, points: ArrayLike) -> NDArray[np.integer]:
        """The block [N] that owns each world point [N, 3]; -1 for points that are not finite."""
        return self.cells.at(self.space.to(points))

    def record(self) -> dict[str, Any]:
        """The partition as a dict for JSON."""
        return {"method": self.method, "space": self.space.record(),
                "regions": [{key: value for key, value in region.record().items()
                             if key != "space"} for region in self.regions],
                "views": [views.tolist() for views in self.views],
                "dropped": {str(view): why for view, why in self.dropped.items()}}

    @classmethod
    def from_record(cls, record: Any) -> Partition:
        """The Partition that `record` described; ValueError for anything else."""
        try:
            regions = tuple(Region.from_record({**region, "space": record["space"]})
                            for region in record["regions"])
            return cls(
                str(record["method"]), regions,
                tuple(np.array(views, int).reshape(-1) for views in record["views"]),
                {int(view): str(why) for view, why in record["dropped"].items()})
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"not a record of a partition ({error})") from None
