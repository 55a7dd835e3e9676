"""A block that its device cannot hold, cut in two."""

import numpy as np

from clsplat.errors import TOO_LARGE
from clsplat.partition.grid import best_cut
from clsplat.partition.partition import Partition


def too_large(outcomes):
    """Numbers of the blocks that failed for memory."""
    return [int(outcome.task.name) for outcome in outcomes
            if not outcome.ok and TOO_LARGE in outcome.message]


def split_blocks(city, scene, numbers, positions_world):
    """Cut these blocks of a CityFolder across their longer side, into halves of equal content.

    scene: the whole; positions_world: float64[N, 3], of the coarse gaussians. The first half keeps
    the number, the other gets a new one; both keep the views. The folders of these blocks are
    removed, the others are theirs as before. Returns the Partition, and which of the blocks could
    not be cut.
    """
    partition = city.partition(scene)
    regions, views, whole = list(partition.regions), list(partition.views), []
    coordinates = partition.space.to(positions_world)
    notes = list(partition.notes)
    for number in numbers:
        region = regions[number]
        axis = int(np.argmax((region.side * partition.space.half)[:2]))
        inside = coordinates[region.holds(coordinates)][:, axis]
        at = best_cut(inside, np.ones(len(inside)), 0.5) if len(inside) else None
        if at is None:
            whole.append(number)
            continue
        regions[number], other = region.cut(axis, at)
        regions.append(other)
        views.append(views[number])
        notes.append(f"block {number:03d} did not fit the device: cut in two, the other half is "
                     f"{len(regions) - 1:03d}")
    made = Partition(partition.method, tuple(regions), tuple(views), partition.dropped,
                     tuple(notes))
    city.replace_partition({**city.read_partition(), **made.record()}, set(numbers) - set(whole))
    return made, whole
