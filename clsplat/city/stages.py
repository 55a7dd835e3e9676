"""The stages of a city in order: begin, train the coarse run, cut (cut.py), train the blocks."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from clsplat.city.cut import cut_into_blocks, whole_steps
from clsplat.city.split import split_blocks, too_large
from clsplat.config.option import differences
from clsplat.device import Device
from clsplat.distribute import Outcome, Task, run
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import final_metrics
from clsplat.io.city import BlockFolder, CityFolder
from clsplat.io.depth import with_depths
from clsplat.io.folders import make_folder
from clsplat.io.run import CITY, RunFolder
from clsplat.io.scene_path import recorded_scene, scene_record
from clsplat.io.scenes import fingerprint, read_scene
from clsplat.io.undistort import undistorted
from clsplat.options import TrainOptions, checked, resolve
from clsplat.partition.input import world_of
from clsplat.scene import Scene
from clsplat.schedule import chooses_steps, schedule_of
from clsplat.training.block import block_options, train_block
from clsplat.training.loop import resume, train
from clsplat.training.photos import THREADS
from clsplat.training.progress import SilentProgress

COARSE_FACTOR = 2  # the coarse run's photos are smaller by this
COARSE_SHARE = 0.5  # of the whole run's steps; at half size they cost a quarter of it or less
MOST_SPLITS = 4  # of a block, one after the other


def begin(city: CityFolder, scene: Scene, options: TrainOptions) -> None:
    """Write the scene and the options of the whole into city.json.

    Raises
    ------
    InputError : the folder holds a city of another scene, or one with other options; or the
        network of `options.lpips` cannot be read; or the options correct poses.
    """
    if options.poses == "on":
        raise InputError("--poses on: is for single runs; the blocks of a city would correct the "
                         "same poses differently, so leave it out")
    final_metrics(options.lpips)  # a network that cannot be read is refused before the work
    record = {**scene_record(scene.path, city.path), "fingerprint": fingerprint(scene),
              "options": dataclasses.asdict(options)}
    if city.has_record:
        earlier = city.read(options=dict)
        if earlier["fingerprint"] != record["fingerprint"]:
            raise InputError(f"{city.path}: is the city of another scene, "
                             f"{earlier.get('scene_absolute')}; choose another --output")
        changed = next(differences(earlier["options"], options), None)
        if changed and RunFolder(city.coarse).is_begun:  # else they have not been used yet
            raise InputError(f"{city.path}: was begun with {changed[0]} {changed[1]}; give the "
                             "same options, or choose another --output")
    else:
        city.check_free()
    make_folder(city.path, "choose another --output")
    city.write(record)


def begin_from_coarse(city: CityFolder, scene_path: Path | None = None
                      ) -> tuple[Scene, TrainOptions]:
    """The scene of a city, and the options of the whole, from city.json.

    That file is written here if the coarse run in CITY/coarse was trained by itself.

    Parameters
    ----------
    scene_path : where the scene is now, if it was moved.
    """
    if city.has_record:
        record = city.read(scene=str, options=dict)
        options = resolve({}, {key: checked(str(city.path / CITY), key, value)
                               for key, value in record["options"].items()})
        scene = read_scene(recorded_scene(record, city.path, scene_path), options.images)
        if fingerprint(scene) != record["fingerprint"]:
            raise InputError(f"{city.path}: its scene {scene.path} has changed since; put it "
                             "back, or begin a new city")
        return scene, options
    run = Run.open(city.coarse)
    coarse = run.options
    if not coarse.coarse:
        raise InputError(f"{city.coarse}: was not trained with --coarse; begin again with "
                         f"`clsplat train SCENE --coarse -o {city.coarse}`")
    scene = run.scene(scene_path, whole=True)
    options = dataclasses.replace(
        coarse, coarse=False, snapshots=False, downscale=max(1.0, coarse.downscale / COARSE_FACTOR),
        max_resolution=COARSE_FACTOR * coarse.max_resolution,
        iterations=(int(coarse.iterations / COARSE_SHARE) if chooses_steps(coarse) else
                    coarse.iterations))
    begin(city, scene, options)
    return scene, options


def train_coarse(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                 progress: SilentProgress | None = None) -> RunFolder:
    """Train the coarse model in CITY/coarse, or continue its training; return its folder."""
    folder = RunFolder(city.coarse)
    if folder.is_begun and folder.read_options().get("fingerprint") != fingerprint(scene):
        raise InputError(f"{folder.path}: is a run of another scene; choose another --output")
    if folder.is_finished:
        return folder
    scene = undistorted(with_depths(scene, options.depth), city.undistorted, THREADS)
    with folder.locked():
        start = resume if folder.is_begun else train
        folder = folder if folder.is_begun else RunFolder.create(city.coarse)
        start(scene, coarse_options(options, scene), device, folder, progress)
    return folder


def coarse_options(options: TrainOptions, scene: Scene) -> TrainOptions:
    """The options of the coarse run: photos half as large as the blocks', and half of the steps.

    Parameters
    ----------
    options, scene : the whole.
    """
    return dataclasses.replace(
        options, coarse=True, downscale=COARSE_FACTOR * options.downscale,
        max_resolution=-(-options.max_resolution // COARSE_FACTOR),
        snapshots="levels" in schedule_of(options.schedule).parts,
        iterations=max(1, int(COARSE_SHARE * whole_steps(options, scene))), eval_at=(),
        eval_every=0, lpips="")


def train_blocks(city: CityFolder, workers: int = 1, scheduler: str = "",
                 devices: Sequence[str] = (),
                 progress: Callable[[str], AbstractContextManager[SilentProgress | None]]
                 | None = None,
                 ended: Callable[[Outcome, str], object] | None = None,
                 began: Callable[[str, str], object] | None = None,
                 fill: bool = False, device: Device | None = None) -> list[Outcome]:
    """Train the blocks that are not finished, the longest first; return the outcome of every block.

    Where blocks exchange gaussians, all of them come to an exchange before any goes on. If one
    fails, the others wait there, or go on alone.

    Parameters
    ----------
    workers, scheduler, devices : see `distribute.run`.
    progress : called with a title such as "block 2 of 9", for a training in this process; returns
        the progress of that training.
    ended : called with each outcome and such a title.
    began : called with the name of a block that begins and such a title.
    fill : whether blocks go on alone when another has failed.
    device : for trainings in this process; None: each opens its own.
    """
    blocks = {block.path.name: block
              for block in sorted(city.blocks(), key=expected_work, reverse=True)}
    exchanges = max((len(block.exchanges) for block in blocks.values()), default=0)
    chosen = ("--device", devices[0]) if len(devices) == 1 and not scheduler else ()

    def train_part(names: Iterable[str], number: int, alone: bool = False) -> list[Outcome]:
        """Train blocks to an exchange, from 1, or to the end after the last one."""
        to_end = alone or number > exchanges
        part = f", part {number} of {exchanges + 1}" if exchanges else ""
        titles = {name: f"block {place} of {len(blocks)}{part}"
                  for place, name in enumerate(blocks, 1)}
        tasks = [Task(name, ("block", str(blocks[name].path.resolve()), "-q", *chosen,
                             *(("--alone",) if alone else ())),
                      RunFolder(blocks[name].run).model_path if to_end else
                      blocks[name].part(number)) for name in names]

        def in_this_process(task: Task) -> None:
            block = blocks[task.name]
            block.check()
            options = block_options(block, **({"device": devices[0]} if devices else {}))
            with progress(titles[task.name]) if progress else nullcontext() as shown:
                train_block(block, options, shown, alone=alone, device=device)

        return run(tasks, workers, scheduler, devices=devices, call=in_this_process,
                   progress=ended and (lambda outcome: ended(outcome, titles[outcome.task.name])),
                   began=began and (lambda name: began(name, titles[name])))

    for number in range(1, exchanges + 1):
        outcomes = train_part(blocks, number)
        failed = {outcome.task.name: outcome for outcome in outcomes if not outcome.ok}
        if failed and fill and not too_large(outcomes):
            rest = train_part([name for name in blocks if name not in failed], number, alone=True)
            return [*failed.values(), *rest]
        if failed:
            return outcomes
    return train_part(blocks, exchanges + 1)


def expected_work(block: BlockFolder) -> int:
    """Steps of a block times the gaussians that it begins to train: its time, in some unit.

    Several workers end at about the same time if they begin with the longest tasks (Graham 1969).
    """
    record = block.read("own", "margin")
    steps = record["options"].get("iterations")  # checked when the block is trained
    gaussians: int = record["own"] + record["margin"]
    return gaussians * (steps if type(steps) is int else 1)


def train_all_blocks(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                     train_present: Callable[[], list[Outcome]]) -> list[Outcome]:
    """Train all blocks by `train_present`, which calls `train_blocks`; those that do not fit their
    device are cut in two."""
    outcomes = train_present()
    for _ in range(MOST_SPLITS):
        numbers = too_large(outcomes)
        if not numbers:
            break
        gaussians = RunFolder(city.coarse).load_model()
        _, whole = split_blocks(city, scene, numbers, world_of(scene, gaussians.positions))
        if len(whole) == len(numbers):
            break
        cut_into_blocks(city, scene, options, None, device)
        outcomes = train_present()
    return outcomes
