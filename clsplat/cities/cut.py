"""Cuts a city into blocks: which views and which start each has, and how many steps it takes."""

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.cities.block import decided_by, options_of_blocks
from clsplat.cities.dense import counted_where, dense_gaussians
from clsplat.cities.exchange import exchange_steps, most_exchanges
from clsplat.cities.visibility import DropTest
from clsplat.config.option import differences, plain
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.atomic import replacing
from clsplat.io.photos.depth import with_depths
from clsplat.io.photos.undistort import undistorted
from clsplat.io.runs.city import DENSE, EXCHANGES, OTHERS, PARTITION, CityFolder
from clsplat.options import RunOptions, TrainOptions
from clsplat.partition.blocks import block_start, filled
from clsplat.partition.input import world_of
from clsplat.partition.make import make_partition
from clsplat.partition.options import BLOCK_STEPS, PartitionOptions
from clsplat.partition.outline import geojson
from clsplat.partition.partition import Partition
from clsplat.partition.windows import find_windows, owned_shares
from clsplat.report.map import write_map
from clsplat.scene import Scene
from clsplat.schedule import SceneFacts, schedule_of, worthwhile_steps
from clsplat.training.photos import THREADS
from clsplat.training.start.prepare import scene_facts, smallest_size

REQUESTED = "asked"  # key of partition.json for the PartitionOptions
JOINT = "joint"  # key of partition.json for the options of the joint training, where there is one
LEAST_VISITS = 0.01  # of a view that was assigned to a block
BLOCKS_TOGETHER = 4  # that are written at the same time, so that few are in memory


def cut_into_blocks(city: CityFolder, scene: Scene, options: TrainOptions,
                    partition_options: PartitionOptions | None, device: Device
                    ) -> tuple[Partition, NDArray[np.integer]]:
    """Make the partition of a city whose coarse run is finished, and the folders of its blocks.

    An existing partition and existing blocks stay as they are.

    Parameters
    ----------
    options : of the whole.
    partition_options : an existing partition must have been made with these, unless this is None.

    Returns
    -------
    The partition, and the coarse gaussians that each block owns, [B].
    """
    # blocks are pinhole scenes
    scene = undistorted(with_depths(scene, options.depth), city.undistorted, THREADS)
    coarse = Run.open(city.coarse)
    small, gaussians = coarse.options, coarse.finished_model
    dense = dense_gaussians(city, scene, gaussians.sh_degree)
    decided = decided_by(coarse.folder)
    training = {view.name for view in scene.split(options.test_every, options.test_offset)[0]}
    views = np.flatnonzero([view.name in training for view in scene.views])
    facts = scene_facts(scene, [scene.views[index] for index in views])
    one_run, _, _ = worthwhile_steps(options, facts, len(views))
    if city.has_partition:
        partition = city.partition(scene)
        if partition_options:
            _check_same(city, partition_options)
    else:
        assert partition_options is not None
        partition_options, drop = partition_options.decided(), None
        if partition_options.method == "citygs" and partition_options.grid != (1, 1):
            drop = DropTest(device, gaussians,
                            scene.reduced(small.downscale, small.max_resolution))
        # citygs was no better for it, and vastgs counts cameras
        weights = (counted_where(gaussians, dense) if partition_options.method == "blockgs"
                   else None)
        partition = make_partition(scene, partition_options, gaussians, views, drop, weights)
        steps_together = partition_options.joint_steps * one_run
        city.write_partition({
            **partition.record(), REQUESTED: plain(partition_options),
            **({JOINT: options_of_joint(options, steps_together, scene, views, facts, decided)}
               if steps_together else {})})
    owner = partition.owner(world_of(scene, gaussians.positions))
    counts = np.bincount(owner, minlength=len(partition.regions))
    exposures = coarse.folder.load_exposures()
    visits = visits_of_blocks(partition, scene, gaussians, owner, requested_of(city).get(
        "block_steps", BLOCK_STEPS))
    steps = [one_run / len(views) * each.sum() for each in visits]
    exchanges = planned_exchanges(city, options, steps)

    def write(number: int) -> None:
        region, chosen = partition.regions[number], partition.views[number]
        own = dataclasses.replace(scene, views=tuple(scene.views[i] for i in chosen),
                                  observations=None)
        windows = find_windows(gaussians, scene, region, own.views)
        own = own.cropped(windows).reduced(options.downscale, options.max_resolution)
        part = block_start(gaussians, scene, region, own.views)
        if dense:
            part = filled(part, dense, scene, region, options.max_gaussians)
        given = block_steps(options, steps[number], smallest_size(own.views), facts)
        if not any(view.depth for view in own.views):
            given["depth"] = ""
        city.write_block(
            number, scene, chosen, region, windows, part.gaussians, exposures,
            options_of_blocks(given, decided),
            {**city.identity(), "views": len(chosen), "own": part.own, "margin": part.margin,
             "surroundings": part.surroundings,
             **({DENSE: part.dense} if dense else {}),
             OTHERS: sorted(set(owner[part.indices].tolist()) - {-1, number}),
             **({EXCHANGES: exchange_steps(given["iterations"], exchanges)} if exchanges else {})},
            {view.name: float(each) for view, each in zip(own.views, visits[number])})

    numbers = ((number,) for number in range(len(partition.regions)))
    for _ in called_ahead(write, numbers, BLOCKS_TOGETHER, BLOCKS_TOGETHER):
        pass  # an error is raised here
    return partition, counts


def visits_of_blocks(partition: Partition, scene: Scene, gaussians: Gaussians,
                     owner: NDArray[np.integer], together: float) -> list[NDArray[np.float64]]:
    """How often each block visits each of its views, where a run of the whole scene does so once.

    In proportion to the share of a view's gaussians that the block owns. So a block learns from
    what shows most of it, and the steps of all blocks together do not depend on how many blocks a
    photo shows. No block takes more steps than one run does with its views.

    Parameters
    ----------
    partition, scene : the whole.
    gaussians, owner : of the coarse run, and the block of each, int[N].
    together : the visits of all blocks, if none takes more steps than one run.
    """
    shares = owned_shares(owner, gaussians.positions.astype(np.float64), scene.views,
                          scene.near_plane, len(partition.regions))
    found = []
    for number, chosen in enumerate(partition.views):
        visits = np.maximum(together * shares[chosen, number], LEAST_VISITS)
        found.append(visits * min(1.0, len(chosen) / visits.sum()))
    return found


def planned_exchanges(city: CityFolder, options: RunOptions, steps: Sequence[float]) -> int:
    """How often the blocks of a city exchange gaussians.

    Not at all with a time budget, as it is not known before when which step is taken.

    Parameters
    ----------
    steps : of the blocks.
    """
    requested = requested_of(city).get("exchanges") or 0
    if options.time_budget or len(steps) < 2:
        return 0
    return min(requested, *(most_exchanges(round(number)) for number in steps))


def block_steps(options: TrainOptions, steps: float, size: tuple[int, int], facts: SceneFacts
                ) -> dict[str, Any]:
    """The options, by name, of a block that takes this number of steps.

    Parameters
    ----------
    size : (width, height) of its smallest training image, pixels.
    facts : about the scene of the whole.
    """
    schedule = schedule_of(options.schedule)
    shrunk = dataclasses.replace(options, iterations=max(1, round(steps)), eval_at=(),
                                 eval_every=0, lpips="", snapshots=False)
    shrunk = dataclasses.replace(shrunk, **schedule.options_of_block(shrunk, size, facts))
    return {field.name: getattr(shrunk, field.name) for field in dataclasses.fields(shrunk)
            if field.name not in ("init", "coarse")}


def options_of_joint(options: TrainOptions, steps: float, scene: Scene,
                     views: NDArray[np.integer], facts: SceneFacts, decided: dict[str, Any]
                     ) -> dict[str, Any]:
    """{option: value} of the joint training, for partition.json.

    It has the levels and growth of one run that begins at dense points, with fewer steps.

    Parameters
    ----------
    options, scene : the whole.
    steps : how many it takes.
    views : indices of the training views, [V].
    facts : about the scene.
    decided : those of `decided_by`.
    """
    given = block_steps(options, steps, smallest_size([scene.views[index] for index in views]),
                        facts)
    return {**options_of_blocks(given, decided), "depth": options.depth,
            "levels": options.levels, "level_reset": options.level_reset}


def draw(city: CityFolder, partition: Partition, scene: Scene, counts: NDArray[np.integer]) -> None:
    """Write the partition as a map and as GeoJSON.

    Parameters
    ----------
    counts : [B], gaussians that each block owns.
    """
    with replacing(city.picture) as file:
        write_map(file, partition, scene, counts)
    with replacing(city.map) as file:
        file.write((json.dumps(geojson(partition, scene, [
            {"gaussians": int(count)} for count in counts])) + "\n").encode())


def requested_of(city: CityFolder) -> dict[str, Any]:
    """The PartitionOptions, by name, with which a city was cut, without those of later versions.

    Raises
    ------
    InputError : the record is damaged.
    """
    recorded = city.read_partition().get(REQUESTED) or {}
    if not isinstance(recorded, dict):
        raise InputError(f"{city.path / PARTITION}: damaged ({REQUESTED} is "
                         f"{str(recorded)[:20]!r}); remove it, and make it with `clsplat partition "
                         f"{city.path}`")
    return recorded


def _check_same(city: CityFolder, options: PartitionOptions) -> None:
    """InputError where the existing blocks were cut with other options."""
    for name, old, new in differences({**plain(options), **requested_of(city)}, options):
        raise InputError(f"{city.path}: was cut with {name.replace('_', '-')} {old}, not {new}; "
                         "remove its partition.json and blocks/, or choose another --output")
