"""What is done to a city's folder, in order: begin, coarse, cut into blocks, train them."""

import dataclasses
import json
from contextlib import nullcontext

import numpy as np

from clsplat.city.split import split_blocks, too_large
from clsplat.city.visibility import DropTest
from clsplat.config.option import differences, plain
from clsplat.distribute import Task, run
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.io.atomic import replacing
from clsplat.io.city import CITY, PARTITION
from clsplat.io.folders import make_folder
from clsplat.io.run import RunFolder
from clsplat.io.scene_path import recorded_scene, scene_record
from clsplat.io.scenes import fingerprint, read_scene
from clsplat.options import checked, resolve
from clsplat.partition.blocks import block_start, find_windows
from clsplat.partition.input import world_of
from clsplat.partition.make import make_partition
from clsplat.partition.outline import geojson
from clsplat.report.map import write_map
from clsplat.schedule import schedule_of
from clsplat.training.block import (
    block_options,
    decided_by,
    options_of_blocks,
    train_block,
)
from clsplat.training.loop import resume, train

COARSE_FACTOR = 2  # by which the coarse run's photos are smaller
COARSE_SHARE = 0.5  # of the whole run's steps; at half size they cost a quarter of it or less
ASKED = "asked"  # key of partition.json: the PartitionOptions
SPLITS = 4  # of a block, one after the other


def begin(city, scene, options):
    """Write what was asked for into city.json; InputError where it holds another scene or other
    options. options: TrainOptions of the whole, as one run would have them."""
    record = {**scene_record(scene.path, city.path), "fingerprint": fingerprint(scene),
              "options": dataclasses.asdict(options)}
    if city.has_record:
        there = city.read(options=dict)
        if there["fingerprint"] != record["fingerprint"]:
            raise InputError(f"{city.path}: is the city of another scene, "
                             f"{there.get('scene_absolute')}; choose another --output")
        changed = next(differences(there["options"], options), None)
        if changed and RunFolder(city.coarse).is_begun:  # else nothing was made of them yet
            raise InputError(f"{city.path}: was begun with {changed[0]} {changed[1]}; give the "
                             "same options, or choose another --output")
    else:
        city.check_free()
    make_folder(city.path, "choose another --output")
    city.write(record)


def begin_from_coarse(city, given=None):
    """(Scene, TrainOptions of the whole) of a city by its city.json, which is written here where
    the coarse run in CITY/coarse was trained by itself. given: where the scene is now, if it was
    moved."""
    if city.has_record:
        record = city.read(scene=str, options=dict)
        options = resolve({}, {key: checked(str(city.path / CITY), key, value)
                               for key, value in record["options"].items()})
        scene = read_scene(recorded_scene(record, city.path, given), options.images)
        if fingerprint(scene) != record["fingerprint"]:
            raise InputError(f"{city.path}: its scene {scene.path} has changed since; put it "
                             "back, or begin a new city")
        return scene, options
    run = Run.open(city.coarse)
    coarse = run.options
    if not coarse.coarse:
        raise InputError(f"{city.coarse}: was not trained with --coarse; begin again with "
                         f"`clsplat train SCENE --coarse -o {city.coarse}`")
    scene = run.scene(given, whole=True)
    options = dataclasses.replace(
        coarse, coarse=False, snapshots=False, downscale=max(1.0, coarse.downscale / COARSE_FACTOR),
        max_resolution=COARSE_FACTOR * coarse.max_resolution,
        iterations=int(coarse.iterations / COARSE_SHARE))
    begin(city, scene, options)
    return scene, options


def train_coarse(city, scene, options, device, progress=None):
    """Train the scaffold into city.coarse, or go on with it; returns its RunFolder."""
    folder = RunFolder(city.coarse)
    if folder.is_begun and folder.read_options().get("fingerprint") != fingerprint(scene):
        raise InputError(f"{folder.path}: is a run of another scene; choose another --output")
    if folder.is_finished:
        return folder
    wanted = coarse_options(options)
    with folder.locked():
        start = resume if folder.is_begun else train
        folder = folder if folder.is_begun else RunFolder.create(city.coarse)
        start(scene, wanted, device, folder, progress)
    return folder


def coarse_options(options):
    """TrainOptions of the coarse run: photos half as large as the blocks', and part of the steps.
    """
    return dataclasses.replace(
        options, coarse=True, downscale=COARSE_FACTOR * options.downscale,
        max_resolution=-(-options.max_resolution // COARSE_FACTOR),
        snapshots="levels" in schedule_of(options.schedule).parts,
        iterations=max(1, int(COARSE_SHARE * options.iterations)), eval_at=(), eval_every=0)


def cut_into_blocks(city, scene, options, wanted, device):
    """Make the Partition of a city whose coarse run is finished, and its blocks' folders.

    options: TrainOptions of the whole; wanted: PartitionOptions, of no use where there is a
    partition. What is there already stays as it is. A block takes as many steps a view as one run
    of the whole would.
    """
    coarse = Run.open(city.coarse)
    small, gaussians = coarse.options, coarse.finished_model
    decided = decided_by(coarse.folder)
    training = {view.name for view in scene.split(options.test_every)[0]}
    views = np.flatnonzero([view.name in training for view in scene.views])
    if city.has_partition:
        city.adopt()
        partition = city.partition(scene)
        _check_asked(city, wanted)
    else:
        drop = None
        if wanted.method == "citygs" and wanted.grid != (1, 1):
            drop = DropTest(device, gaussians,
                            scene.reduced(small.downscale, small.max_resolution))
        partition = make_partition(scene, wanted, gaussians, views, drop)
        city.write_partition({**partition.record(), ASKED: plain(wanted)})
    counts = np.bincount(partition.owner(world_of(scene, gaussians.positions)),
                         minlength=len(partition.regions))
    draw(city, partition, scene, counts)
    exposures = coarse.exposures
    for number, (region, chosen) in enumerate(zip(partition.regions, partition.views)):
        share = len(chosen) / len(views)
        given = block_steps(options, share)
        shown = dataclasses.replace(scene, views=tuple(scene.views[i] for i in chosen),
                                    observations=None)
        windows = find_windows(gaussians, scene, region, shown.views)
        shown = shown.cropped(windows).reduced(options.downscale, options.max_resolution)
        part = block_start(gaussians, scene, region, shown.views)
        city.write_block(
            number, scene, chosen, region, windows, part.gaussians, exposures,
            options_of_blocks(given, decided),
            {**city.identity(), "views": len(chosen), "own": part.own, "margin": part.margin,
             "surroundings": part.surroundings})
    return partition, counts


def block_steps(options, share):
    """{option: value} of a block with this share of the views."""
    steps = max(1, round(options.iterations * share))
    schedule = schedule_of(options.schedule)
    shrunk = dataclasses.replace(options, iterations=steps, eval_at=(), eval_every=0,
                                 snapshots="levels" in schedule.parts,
                                 **schedule.options_of_block(options))
    return {field.name: getattr(shrunk, field.name) for field in dataclasses.fields(shrunk)
            if field.name not in ("init", "coarse")}


def draw(city, partition, scene, counts):
    """Write the partition as a map and as GeoJSON; counts: int[B], gaussians that each block owns.
    """
    with replacing(city.picture) as file:
        write_map(file, partition, scene, counts)
    with replacing(city.map) as file:
        file.write((json.dumps(geojson(partition, scene, [
            {"gaussians": int(count)} for count in counts])) + "\n").encode())


def train_blocks(city, workers=1, scheduler="", devices=(), progress=None, told=None, began=None):
    """Train what is not finished; the Outcome of every block.

    workers, scheduler, devices: see `distribute.run`; progress: called with "block 2 of 9", say,
    makes that of a training, a context manager, where blocks are trained one after the other in
    this process; told: called with each Outcome as it comes, and began with a block's name as it
    begins, both with "block 2 of 9", say, after that.
    """
    blocks = {block.path.name: block for block in city.blocks()}
    places = {name: f"block {number} of {len(blocks)}" for number, name in enumerate(blocks, 1)}
    chosen = ("--device", devices[0]) if len(devices) == 1 else ()
    tasks = [Task(name, ("block", str(block.path.resolve()), "-q", *chosen),
                  RunFolder(block.run).model_path)
             for name, block in blocks.items()]

    def here(task):
        block = blocks[task.name]
        block.check()
        options = block_options(block, **({"device": devices[0]} if devices else {}))
        with progress(places[task.name]) if progress else nullcontext() as shown:
            train_block(block, options, shown)

    return run(tasks, workers, scheduler, devices=devices, call=here,
               progress=told and (lambda outcome: told(outcome, places[outcome.task.name])),
               began=began and (lambda name: began(name, places[name])))


def train_all_blocks(city, scene, options, device, **how):
    """`train_blocks`; blocks that do not fit their device are cut in two and begun again."""
    outcomes = train_blocks(city, **how)
    for _ in range(SPLITS):
        numbers = too_large(outcomes)
        if not numbers:
            break
        gaussians = RunFolder(city.coarse).load_model()
        _, whole = split_blocks(city, scene, numbers, world_of(scene, gaussians.positions))
        if len(whole) == len(numbers):
            break
        cut_into_blocks(city, scene, options, None, device)
        outcomes = train_blocks(city, **how)
    return outcomes


def _check_asked(city, wanted):
    """InputError where the blocks that are there were cut as PartitionOptions say otherwise."""
    asked = city.read_partition().get(ASKED) or {}
    if not isinstance(asked, dict):
        raise InputError(f"{city.path / PARTITION}: damaged ({ASKED} is {str(asked)[:20]!r}); "
                         f"remove it, and make it with `clsplat partition {city.path}`")
    for name, there, here in differences({**plain(wanted), **asked}, wanted) if wanted else ():
        raise InputError(f"{city.path}: was cut with {name.replace('_', '-')} {there}, not {here}; "
                         "remove partition.json and blocks/ there, or choose another --output")
