"""Blocks that do not fit their device are cut in two."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clsplat.distribute import Outcome
from clsplat.errors import TOO_LARGE
from clsplat.io.runs.city import CityFolder
from clsplat.partition.grid import best_cut
from clsplat.partition.partition import Partition
from clsplat.scene import Scene


def too_large(outcomes: Iterable[Outcome]) -> list[int]:
    """Numbers of the blocks that failed for lack of device memory."""
    return [int(outcome.task.name) for outcome in outcomes
            if not outcome.ok and TOO_LARGE in outcome.message]


def split_blocks(city: CityFolder, scene: Scene, numbers: Iterable[int],
                 positions_world: NDArray[np.float64]) -> tuple[Partition, list[int]]:
    """Cut blocks of a city across their longer side, into halves of equal content.

    The first half keeps the number, the other gets a new one; both keep the views. The folders of
    these blocks are removed, those of the others stay.

    Parameters
    ----------
    scene : the whole.
    positions_world : [N, 3], of the coarse gaussians.

    Returns
    -------
    The new partition, and the numbers of the blocks that could not be cut.
    """
    partition = city.partition(scene)
    regions, views = list(partition.regions), list(partition.views)
    whole: list[int] = []
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
