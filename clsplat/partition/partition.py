"""The result: which block owns which part of the world, and which views each block is given."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from clsplat.partition.region import Region


class Cells:
    """Which of many Regions of one space holds a place. Raises ValueError where two overlap.

    edges: the ends of the cells along each axis, ascending; table: int[., ., .], the cell between
    any two of them, -1 for none.
    """

    def __init__(self, regions):
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

    def at(self, coordinates):
        """int[N]: the cell of each place [N, 3] of the space; -1 for one that is not finite."""
        place = tuple(np.searchsorted(e, column, side="right")
                      for e, column in zip(self.edges, coordinates.T))
        return np.where(np.isfinite(coordinates).all(axis=1), self.table[place], -1)


@dataclass(frozen=True, eq=False)
class Partition:
    """Blocks of one scene. Their cells share a space and fill it, each place once.

    method: its name; regions: a Region a block; views: int[K] a block, ascending, indices into
    scene.views; dropped: {index of a view: why no block takes it}; notes: what else a reader must
    know, a line each. Raises ValueError where the cells overlap or leave gaps.
    """

    method: str
    regions: tuple[Region, ...]
    views: tuple[np.ndarray, ...]
    dropped: dict[int, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        if not self.regions or len(self.regions) != len(self.views):
            raise ValueError(f"{len(self.regions)} regions and {len(self.views)} lists of views")
        spaces = {id(region.space): region.space.record() for region in self.regions}
        if any(space != self.space.record() for space in spaces.values()):
            raise ValueError("the blocks' spaces differ")
        if (self.cells.table < 0).any():
            raise ValueError("the blocks leave a gap")

    def check_views(self, count):
        """ValueError where a view is none of `count`."""
        for index in (*self.dropped, *(int(i) for views in self.views for i in views)):
            if not 0 <= index < count:
                raise ValueError(f"view {index} of {count}")

    @property
    def space(self):
        return self.regions[0].space

    @cached_property
    def cells(self):
        return Cells(self.regions)

    def owner(self, points):
        """int[N]: the block of each world point [N, 3]; -1 for one that is not finite."""
        return self.cells.at(self.space.to(points))

    def record(self):
        """A dict for JSON."""
        return {"method": self.method, "space": self.space.record(),
                "regions": [{key: value for key, value in region.record().items()
                             if key != "space"} for region in self.regions],
                "views": [views.tolist() for views in self.views],
                "dropped": {str(view): why for view, why in self.dropped.items()},
                "notes": list(self.notes)}

    @classmethod
    def from_record(cls, record):
        """The Partition of a `record`; ValueError for anything else."""
        try:
            regions = tuple(Region.from_record({**region, "space": record["space"]})
                            for region in record["regions"])
            return cls(
                str(record["method"]), regions,
                tuple(np.array(views, int).reshape(-1) for views in record["views"]),
                {int(view): str(why) for view, why in record["dropped"].items()},
                tuple(str(note) for note in record["notes"]))
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"no record of a partition ({error})") from None
