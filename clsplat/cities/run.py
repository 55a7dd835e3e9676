"""A large scene, block by block: from the scene to the merged model, and its stages by themselves.

`clsplat city`, `clsplat partition` and `clsplat merge` print what these functions report.
"""

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clsplat.cities.block import train_blocks
from clsplat.cities.city import City, Shown, timed, train_coarse
from clsplat.cities.cluster import connected
from clsplat.cities.cut import cut_into_blocks, requested_of
from clsplat.cities.dense import find_dense_gaussians, search_of
from clsplat.cities.merge import Merged, evaluate_city, merge_city_tree, merged_city, reference_file
from clsplat.cities.workers import Workers
from clsplat.config.option import is_auto
from clsplat.device import Device, choose_device
from clsplat.errors import InputError, Interrupted
from clsplat.estimate.forecast import Forecast
from clsplat.gaussians import LEARNED
from clsplat.io.runs.city import CityFolder, StageTime
from clsplat.io.runs.run import RunFolder
from clsplat.options import SceneOptions, ScheduledOptions, TrainOptions, bytes_of
from clsplat.partition.options import BLOCK_STEPS, JOINT_STEPS, LEAST_GAUSSIANS, PartitionOptions
from clsplat.report.page import Table
from clsplat.scene import Scene
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.registry import schedule_of
from clsplat.schedule.steps import worthwhile_steps
from clsplat.training.photos import size_note
from clsplat.training.start.prepare import PreparedScene, scene_facts

STARTS = ("sfm", "dense")  # of a city's blocks: the coarse model, or dense points in its gaps too
STEPS = ("joint_steps", "exchanges", "block_steps")  # options that a city keeps once it is cut
# where several blocks share a GPU: at most so many, with so many cores of the host for each
MOST_SHARING, CORES_SHARING = 4, 4
# of the device's memory for parameters and moments: frames take as much again, photos a quarter,
# and growth holds a part of the model twice for a moment
MODEL_SHARE = 0.27
# by so much, what is expected of blocks that share a device is too little. Of a made survey they
# trained 2.2 times as many gaussians, which took 40 % of the memory that is planned for these
UNCERTAIN = 1.5
LEAST_JOINT_STEPS = 450  # fewer are not worth it
PIXELS_PER_GAUSSIAN = 40  # of training photos, where the schedule has no limit
PIXELS_OF_A_PLACE = 10  # for a gaussian, of one of the photos that show it: 9.3 of a made survey
# of larger cities
GIB = 2**30
COARSE_COST = 0.25  # time of the coarse run, as a share of the time of one run of the whole
PLY_BYTES = 248  # of a gaussian with all spherical harmonics


@dataclass(frozen=True, eq=False)
class Finished:
    """A merged city; `evaluated` : a tree is not; `scores`, `seams` : see `evaluate_city`."""

    merged: Merged
    evaluated: bool = False
    scores: dict[str, Any] | None = None
    seams: dict[str, Any] | None = None


def city(
    scene: Scene,
    options: TrainOptions,
    output: Path,
    *,
    partition: Mapping[str, Any] | None = None,
    workers: int | None = None,
    devices: Sequence[str] = (),
    scheduler: str = "",
    fill: bool = False,
    against: Path | None = None,
    tree: bool = False,
    shown: Shown | None = None,
) -> Finished:
    """Train a large scene in blocks, and merge them; see `clsplat.city` for the other arguments.

    The stages are a coarse run, partition, training of the blocks, merge, joint training and
    evaluation. After any failure, the same call continues.

    Parameters
    ----------
    against : a run of the whole scene, or its PLY, as the reference for seams; None: the coarse
        model.
    tree : merge into a tree of levels of detail, with one block at a time in memory; nothing is
        evaluated.
    shown : receives what is being done.

    Raises
    ------
    InputError : the scene, an option or the folder cannot be used, or a block has failed.
    Interrupted : it was stopped; the state is saved.
    """
    if options.coarse or not (is_auto(options.init) or options.init in STARTS):
        raise InputError(
            "--init, --coarse: a city begins with its own coarse run; leave them out, "
            f"or give --init {' or '.join(STARTS)}"
        )
    shown, folder, reference = shown or Shown(), CityFolder(output), reference_file(against, tree)
    if workers is None and scheduler:
        workers = 1
    Workers(workers or 1)  # refuses a wrong number before the device is opened
    whole = City(folder, scene, options, choose_device(devices[0] if devices else options.device, form=options.form))
    cutting = chosen_partition(
        partition or {}, whole, workers, workers if scheduler and workers else max(1, len(devices)), tree
    )
    if scheduler and not RunFolder(folder.coarse).has_model:
        connected(scheduler).close()
    if not folder.has_record:
        folder.check_free()
    with RunFolder(folder.path).locked(), Workers(cutting.workers, scheduler, devices) as all_:
        whole.begin()
        for note in (size_note(scene.views, options), one_block_note(cutting, scene.path)):
            if note:
                shown.line(note)
        with _stopped_at(folder):
            search = all_.begin(search_of(whole)) if not folder.has_partition else None
            with shown.stage("coarse run") as progress, timed(folder, "coarse run"):
                train_coarse(whole, progress, cutting.joint_steps > 0)
            with shown.stage("start of blocks") as progress:
                if found := all_.end(search):
                    folder.add_stage(StageTime("dense points", found[1], *found[0]))
                else:  # there is no other process, or it failed, which this one may explain
                    with timed(folder, "dense points"):
                        find_dense_gaussians(whole, progress)
            with timed(folder, "cut"):
                shown.line(cut_into_blocks(whole, cutting).text())
            train_blocks(folder, all_, whole.device, shown, fill)
        return merge_city(whole, fill, reference, tree, shown=shown)


def cut_city(folder: CityFolder, partition: Mapping[str, Any], scene_path: Path | None = None) -> str:
    """Cut the scene of a city with a finished coarse run into blocks; the table of the blocks.

    `partition` : fields of PartitionOptions; `scene_path` : where the scene is now, if it was
    moved.
    """
    folder.check_there()
    with RunFolder(folder.path).locked():
        city = City.open(folder, scene_path)
        cutting = chosen_partition(partition, city)
        find_dense_gaussians(city)
        return cut_into_blocks(city, cutting).text()


def merge_city(
    city: City, fill: bool = False, reference: Path | None = None, tree: bool = False, shown: Shown | None = None
) -> Finished:
    """Merge the finished blocks of a city, train the whole jointly, and evaluate it; arguments as
    for `city`, `reference` : as `reference_file` returns it."""
    if tree:
        return Finished(merge_city_tree(city, fill))
    with _stopped_at(city.folder), (shown or Shown()).stage("joint training") as progress, timed(city.folder, "merge"):
        merged = merged_city(city, fill, progress)
    return Finished(merged, True, *evaluate_city(city, merged, reference))


@contextmanager
def _stopped_at(folder: CityFolder) -> Iterator[None]:
    """Let an Interrupted in the block say how the city goes on."""
    try:
        yield
    except Interrupted:
        raise Interrupted(f"{folder.path}: stopped, the state is saved; the same command continues") from None


def chosen_partition(
    given: Mapping[str, Any], city: City, workers: int | None = 1, devices: int = 1, tree: bool = False
) -> PartitionOptions:
    """The PartitionOptions with given fields, and others chosen.

    By default the blocks of the workers that share a device fit it together, and a city that is cut
    already keeps its steps. `workers` : None: as many as share the `devices` well."""
    options = city.options
    facts, photos = facts_of_whole(city.scene, options)
    expected, fit = expected_gaussians(facts, options), gaussians_that_fit(city.device, options)
    number = workers or devices
    recorded = requested_of(city.folder) if city.folder.has_partition else {}
    chosen = PartitionOptions(
        **{
            **{name: recorded[name] for name in STEPS if name in recorded},
            **given,
            "expected": expected,
            "block_gaussians": given.get("block_gaussians")
            or max(LEAST_GAUSSIANS, int(fit / max(1, number / devices))),
            "least_blocks": min(number, max(1, expected // LEAST_GAUSSIANS)),
            "workers": number,
        }
    )
    if workers is None and not city.device.is_cpu:
        # a GPU works for one block while others read, write and exchange
        sharing = min(
            MOST_SHARING,
            math.ceil(chosen.blocks / devices),
            (os.cpu_count() or 1) // CORES_SHARING,
            int(fit / UNCERTAIN / (chosen.trained / chosen.blocks)),
        )
        rounds = math.ceil(chosen.blocks / (devices * max(1, sharing)))  # with fewer at a time
        chosen = replace(chosen, workers=devices * math.ceil(chosen.blocks / (devices * rounds)))
    chosen = replace(chosen, sharing=math.ceil(chosen.workers / devices))
    return chosen.decided(
        not (recorded or tree) and chosen.blocks > 1 and expected <= fit and trains_jointly(facts, photos, options)
    )


def facts_of_whole(scene: Scene, options: SceneOptions) -> tuple[SceneFacts, int]:
    """(The facts of the whole scene for its schedule, the number of training photos)."""
    scene = scene.reduced(options.downscale, options.max_resolution)
    views, _ = scene.split(options.test_every, options.test_offset)
    return scene_facts(scene, views), len(views)


def expected_gaussians(facts: SceneFacts, options: ScheduledOptions) -> int:
    """About how many gaussians the whole scene, with these facts, has at the end."""
    schedule = schedule_of(options.schedule)
    limit, _ = schedule.planned_limit(options, facts)
    expected = facts.pixels // PIXELS_PER_GAUSSIAN if limit is None else limit
    if schedule.begins_dense and facts.shown_in >= 1:  # false for a nan
        expected = min(expected, int(facts.pixels / facts.shown_in / PIXELS_OF_A_PLACE))
    return max(facts.count, expected)


def gaussians_that_fit(device: Device, options: ScheduledOptions) -> int:
    """How many gaussians a block may have at the end on a device, within a memory budget."""
    floats = sum(field.width(options.sh_degree) for field in LEARNED)
    each = 3 * floats * device.real.itemsize
    memory = device.handle.global_mem_size
    if options.memory_budget:
        memory = min(memory, bytes_of(options.memory_budget))
    return max(1, int(MODEL_SHARE * memory / each))


def scale_table(
    prepared: PreparedScene,
    options: ScheduledOptions,
    forecast: Forecast,
    device: Device,
    photos: Iterable[int],
    workers: int = 1,
) -> Table:
    """The cost of scenes with more photos like those of a prepared one, a row for each number.

    Everything grows with the number of photos, but a single run takes the steps that its schedule
    has for so many, and a block is as large as the device allows, or smaller where there are more
    devices: `workers`, that train blocks at the same time. `options` are those that were given.
    """
    views, facts = prepared.train_views, prepared.decisions.facts
    area = sum(view.camera.width * view.camera.height for view in views) / len(views)
    limit, shared = gaussians_that_fit(device, options), (1 + 2 * PartitionOptions().margin) ** 2
    rows = []
    for count in photos:
        share = count / len(prepared.scene.views)
        gaussians = int(forecast.gaussians * share)
        whole = gaussians <= limit and workers == 1
        times, visits = (1, 1.0) if whole else (shared, BLOCK_STEPS)  # blocks that train a gaussian
        blocks = max(-(-int(gaussians * times) // limit), workers)
        coarse = 0.0 if whole else COARSE_COST * forecast.seconds * share
        longer = share * visits
        if whole and is_auto(options.iterations):
            longer = (
                worthwhile_steps(options, facts, round(share * len(views)))[0]
                / worthwhile_steps(options, facts, len(views))[0]
            )
        trained = forecast.seconds * longer
        elapsed = coarse + trained / blocks * -(-blocks // workers)
        rows.append(
            (
                f"{count:,}",
                f"{blocks:,}",
                f"{count * times / blocks:,.0f}",
                f"{forecast.steps * longer / blocks:,.0f}",
                f"{gaussians:,}",
                f"{gaussians * PLY_BYTES / GIB:,.1f}",
                f"{3 * area * count / GIB:,.1f}",
                f"{(trained + coarse) / 3600:,.3g}",
                f"{elapsed / 3600:,.3g}",
            )
        )
    head = (
        "photos",
        "blocks",
        "photos a block",
        "steps a block",
        "gaussians at most",
        "model, GiB",
        "pixels, GiB",
        "device hours",
        f"hours on {workers}",
    )
    return Table(
        "At scale",
        head,
        rows,
        range(9),
        (
            f"For photos like these, on {device.name}, in as few blocks as fit it and at "
            f"least one a device. Several take {BLOCK_STEPS:g} times the steps of one run together, "
            "after a coarse run on one device.",
        ),
    )


def trains_jointly(facts: SceneFacts, photos: int, options: ScheduledOptions) -> bool:
    """Whether a city whose model a device holds is trained jointly at the end, if nobody says so.

    Only where one run takes all the steps that its photos allow: with fewer, blocks gain more by
    steps of their own (docs/evidence/cities.md). Other schedules than sig are trained as they were
    published, and a time budget is one of each block."""
    steps, most, _ = worthwhile_steps(options, facts, photos)
    return (
        "sig" in schedule_of(options.schedule).parts
        and not options.time_budget
        and steps == most
        and JOINT_STEPS * steps >= LEAST_JOINT_STEPS
    )


def one_block_note(options: PartitionOptions, scene: Path) -> str:
    """That a scene which fits the device in one block needs no city; empty for others."""
    if options.grid or options.blocks > 1:
        return ""
    return (
        f"this device holds the whole model in one block: `clsplat train {scene}` trains it in "
        "one stage, which is quicker and as good; --grid cuts it all the same"
    )
