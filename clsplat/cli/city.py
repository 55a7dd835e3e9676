"""`clsplat city` and its stages `partition` and `merge`: large scenes, block by block."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.city.sharing import CORES_SHARING, MOST_SHARING, blocks_sharing, most_sharing
from clsplat.cli.flags import (
    Parsed,
    TrainingCommand,
    config_options,
    flags_of,
    given_options,
    training_flags,
)
from clsplat.cli.sections import SectionedCommand, SectionedOption
from clsplat.cli.train import ending
from clsplat.config.option import AUTO, is_auto
from clsplat.errors import InputError, Interrupted
from clsplat.partition.options import LEAST_GAUSSIANS, PartitionOptions

if TYPE_CHECKING:
    from clsplat.cli.progress import Progress
    from clsplat.device import Device
    from clsplat.distribute import Outcome, Workers
    from clsplat.io.runs.city import CityFolder
    from clsplat.options import TrainOptions
    from clsplat.scene import Scene

# what the tasks of blocks and of scores need
IMPORTED_BY_CHILDREN = ("clsplat.cli.block", "clsplat.city.seams")
STEPS = ("joint_steps", "exchanges", "block_steps")  # options that a city keeps once it is cut
STARTS = ("sfm", "dense")  # of a city's blocks: the coarse model, or dense points in its gaps too
BLOCKS: dict[str, Any] = {"cls": SectionedOption, "section": "Blocks"}
TREE_HELP = ("Merge into a tree of levels of detail, CITY/point_cloud.tree, which `render`, `film` "
             "and `view` read in parts, in place of point_cloud.ply: one block at a time is in "
             "memory, and nothing is evaluated.")


def number_of_workers(text: str) -> int | None:
    """What --workers says; None for auto."""
    try:
        return None if is_auto(text) else int(text)
    except ValueError:
        raise ValueError("not a number of workers; give auto or a whole number") from None


@click.command(cls=TrainingCommand)
@click.argument("scene", type=click.Path(path_type=Path))
@training_flags
@flags_of(PartitionOptions)
@click.option("-o", "--output", type=click.Path(path_type=Path), **BLOCKS,
              help="Folder of the city; default: SCENE.city.")
@click.option("--workers", type=Parsed("INTEGER", number_of_workers), default=AUTO,
              show_default=True, metavar="[auto|INTEGER]", **BLOCKS,
              help="Number of blocks that are trained at a time on this machine, and of processes "
              "that score the result; --grid auto makes at least as many blocks, and more where "
              "the last worker then ends earlier. auto: one for each device, or as many as share "
              f"a GPU well: up to {MOST_SHARING}, with {CORES_SHARING} cores for each, and blocks "
              "that fit its memory together. With --scheduler: for how many workers to cut.")
@click.option("--scheduler", default="", **BLOCKS, help="Address of a Dask scheduler, such as "
              "tcp://10.0.0.1:8786, whose workers train the blocks and score the result.")
@click.option("--fill", is_flag=True, **BLOCKS, help="Where a block fails, use the coarse model's "
              "gaussians; the report says so.")
@click.option("--against", type=click.Path(path_type=Path), **BLOCKS, help="A run of the whole "
              "scene, or its PLY, as the reference for seams, in place of the coarse model.")
@click.option("--tree", is_flag=True, **BLOCKS, help=TREE_HELP)
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
@click.pass_context
def city(ctx: click.Context, /, scene: Path, output: Path | None, workers: int | None,
         scheduler: str, fill: bool, against: Path | None, tree: bool, quiet: bool,
         **_options: object) -> None:
    """Train a large SCENE in blocks, and merge them.

    The stages are a coarse run, partition, training of the blocks, merge and evaluation. After any
    failure, the same command continues. The folder is a run like any other, for `clsplat eval`,
    `render` and `compare`. For several devices, use --device 0,1.
    """
    from clsplat.distribute import Children, Workers, check_scheduler, check_workers
    from clsplat.options import resolve
    given = {**config_options(ctx), **given_options(ctx)}
    devices = _devices(given.pop("device", ""), workers, scheduler)
    options = resolve({}, {**given, **({"device": devices[0]} if devices else {})})
    if workers is None and scheduler:
        workers = 1
    if workers is not None:
        check_workers(workers)
    if options.coarse or not (is_auto(options.init) or options.init in STARTS):
        raise InputError("--init, --coarse: a city begins with its own coarse run; leave them out, "
                         f"or give --init {' or '.join(STARTS)}")
    opens = f"clsplat.training.block:device_of_tasks:{options.device}:{options.form}"

    def started(number: int) -> Children | None:
        """Child processes for the blocks, which end with this command; None: it needs none."""
        return (ctx.with_resource(Children(number, devices, (opens, *IMPORTED_BY_CHILDREN)))
                if number > 1 and not scheduler else None)

    used = max(1, len(devices))
    cut = given_options(ctx, PartitionOptions)
    blocks = math.prod(cut.get("grid") or (1, 1))
    # they start before the imports of this process and before its device is known, which take as
    # long as their own imports
    children = started(workers or used * most_sharing(math.ceil(blocks / used)))
    from clsplat.city.blocks import train_all_blocks, train_blocks
    from clsplat.city.cut import cut_into_blocks, draw
    from clsplat.city.dense import find_dense_gaussians, found_beside
    from clsplat.city.forecast import block_table, one_block_note
    from clsplat.city.stages import begin, train_coarse
    from clsplat.device import choose_device
    from clsplat.io.runs.city import CityFolder
    from clsplat.io.runs.run import RunFolder
    from clsplat.io.scenes.read import read_scene
    from clsplat.training.photos import size_note
    against = _reference(against, tree)
    data = read_scene(scene, options.images)
    folder = CityFolder(output or _beside(scene))
    device = [choose_device(name, form=options.form) for name in devices or (options.device,)][0]
    cutting = partition_options(cut, data, options, device, folder, workers,
                                workers if scheduler and workers else used, tree)
    if children and len(children) != cutting.workers:  # blocks cannot share this device
        children.end()
        children = None
    children = children or started(cutting.workers)
    all_workers = Workers(cutting.workers, scheduler, devices, children)
    if scheduler and not RunFolder(folder.coarse).has_model:
        check_scheduler(scheduler)
    if not folder.has_record:
        folder.check_free()
    ctx.with_resource(RunFolder(folder.path).locked())
    begin(folder, data, options)
    if not quiet:
        for note in (size_note(data.views, options), one_block_note(cutting, scene)):
            if note:
                click.echo(note)

    shown = partial(_shown, quiet, options)

    def began(name: str, title: str) -> None:
        if not quiet and all_workers.several:
            click.echo(f"{title}: training in blocks/{name}")

    def ended(outcome: Outcome, title: str) -> None:
        if not quiet:
            click.echo(f"{title} (blocks/{outcome.task.name}): "
                       f"{'finished' if outcome.ok else 'failed'} after {outcome.seconds:.0f} s")

    try:
        # a city with a joint training is so small that the host can hold the photos of both; with
        # several devices all but one would wait for the coarse run
        helpers = children if cutting.joint_steps or len(devices) > 1 else None
        with found_beside(folder, data, options, helpers) as found:
            with shown("coarse run") as progress:
                train_coarse(folder, data, options, device, progress, cutting.joint_steps > 0)
            with shown("start of blocks") as progress:
                if not found():
                    find_dense_gaussians(folder, data, options, device, progress)
        partition, counts = cut_into_blocks(folder, data, options, cutting, device)
        if not quiet:  # trial steps would keep the other devices waiting
            click.echo(block_table(folder, None if all_workers.several else device, counts).text())
        with ThreadPoolExecutor(1) as beside:
            drawn = beside.submit(draw, folder, partition, data, counts)
            outcomes = train_all_blocks(folder, data, options, device, lambda: train_blocks(
                folder, all_workers, shown, ended, began, fill, device))
            drawn.result()
    except Interrupted:
        raise _stopped(folder) from None
    failed = [outcome for outcome in outcomes if not outcome.ok]
    for outcome in failed:
        click.echo(f"block {outcome.task.name} failed on {outcome.worker}: {outcome.message}",
                   err=True)
    _finish(folder, data, options, device, all_workers, fill, against, tree, quiet)


@click.command("partition", cls=SectionedCommand)
@click.argument("folder", metavar="CITY", type=click.Path(path_type=Path))
@flags_of(PartitionOptions)
@click.option("--scene", type=click.Path(path_type=Path), **BLOCKS, help="Where the scene is now, "
              "if it was moved.")
@click.pass_context
def partition_command(ctx: click.Context, /, folder: Path, scene: Path | None, **_options: object
                      ) -> None:
    """Cut the scene of CITY into blocks.

    Needs a finished coarse run in CITY/coarse. Writes partition.json, partition.geojson, the map
    partition.png, and a folder for each block.
    """
    from clsplat.city.cut import cut_into_blocks, draw
    from clsplat.city.dense import find_dense_gaussians
    from clsplat.city.forecast import block_table
    from clsplat.city.stages import begin_from_coarse
    from clsplat.device import choose_device
    from clsplat.io.runs.city import CityFolder
    from clsplat.io.runs.run import RunFolder
    city = CityFolder(folder)
    city.check_there()
    ctx.with_resource(RunFolder(folder).locked())
    data, options = begin_from_coarse(city, scene)
    device = choose_device(options.device, form=options.form)
    cutting = partition_options(given_options(ctx, PartitionOptions), data, options, device, city)
    find_dense_gaussians(city, data, options, device)
    partition, counts = cut_into_blocks(city, data, options, cutting, device)
    draw(city, partition, data, counts)
    click.echo(block_table(city, device, counts).text())
    click.echo(f"{city.picture}")


@click.command()
@click.argument("folder", metavar="CITY", type=click.Path(path_type=Path))
@click.option("--fill", is_flag=True, help="Use the coarse model's gaussians where a block is "
              "missing, unfinished, or has too few gaussians; the report says so.")
@click.option("--against", type=click.Path(path_type=Path), help="A run of the whole scene, or its "
              "PLY, as the reference for seams, in place of the coarse model.")
@click.option("--tree", is_flag=True, help=TREE_HELP)
@click.option("--joint/--no-joint", default=True, show_default=True, help="Train the merged model "
              "as a whole, where the partition of the city includes that (--joint-steps).")
@click.option("--device", default="auto", show_default=True,
              help="auto, cpu, gpu, a number of `clsplat devices`, or part of a name.")
@click.option("--scene", type=click.Path(path_type=Path), help="Where the scene is now, if it was "
              "moved.")
@click.pass_context
def merge(ctx: click.Context, folder: Path, fill: bool, against: Path | None, tree: bool,
          joint: bool, device: str, scene: Path | None) -> None:
    """Merge the finished blocks of CITY into one model.

    That may then be trained as a whole, and is evaluated on the held-out views. If blocks are
    missing, the command lists them and ends with exit code 2.
    """
    from clsplat.city.stages import begin_from_coarse
    from clsplat.device import choose_device
    from clsplat.distribute import ONE_WORKER
    from clsplat.io.runs.city import CityFolder
    from clsplat.io.runs.run import RunFolder
    city = CityFolder(folder)
    city.check_there()
    against = _reference(against, tree)
    ctx.with_resource(RunFolder(folder).locked())
    data, options = begin_from_coarse(city, scene)
    _finish(city, data, options, choose_device(device), ONE_WORKER, fill, against, tree,
            joint=joint)


def _shown(quiet: bool, options: TrainOptions, title: str
           ) -> AbstractContextManager[Progress | None]:
    from clsplat.cli.progress import Progress
    return nullcontext() if quiet else Progress(options.stop_at, title=title)


def _stopped(folder: CityFolder) -> Interrupted:
    return Interrupted(f"{folder.path}: stopped, the state is saved; the same command continues")


def _reference(against: Path | None, tree: bool) -> Path | None:
    from clsplat.city.finish import reference_file
    if against and tree:
        raise InputError("--against: has no effect with --tree, which measures no seams; leave one "
                         "of them out")
    return reference_file(against)


def _finish(folder: CityFolder, data: Scene, options: TrainOptions, device: Device,
            workers: Workers, fill: bool, against: Path | None, tree: bool, quiet: bool = False,
            joint: bool = True) -> None:
    from clsplat.city.finish import evaluate_city, merge_city_tree, merge_record, merged_city
    from clsplat.cli.evaluate import summary
    from clsplat.io.models.tree import TREE
    from clsplat.report.city import seam_table, share_table
    if tree:
        merged = merge_city_tree(folder, data, options, device, fill)
        if not quiet:
            click.echo(share_table(merged.record()).text())
            click.echo(f"{folder.path / TREE}: {merged.count:,} gaussians of "
                       f"{len(merged.shares)} blocks")
        return
    with ExitStack() as stack:
        try:
            with _shown(quiet, options, "joint training") as progress:
                merged = stack.enter_context(
                    merged_city(folder, data, options, device, fill, progress, joint))
        except Interrupted:
            raise _stopped(folder) from None
        scores, seams = evaluate_city(folder, options, device, merged, against, workers)
    if against and seams is None:
        click.echo("--against: not used, since a single block has no seams", err=True)
    if quiet:
        return
    click.echo(share_table(merge_record(folder)).text())
    if seams:
        click.echo(seam_table(seams).text())
    if scores:
        click.echo(summary(scores))
    blocks = len(merged.shares)
    click.echo(f"{folder.path}: {merged.count:,} gaussians of {blocks} block{'s' * (blocks != 1)}")
    click.echo("\n".join(ending(folder.path)))


def partition_options(given: dict[str, Any], scene: Scene, options: TrainOptions, device: Device,
                      city: CityFolder, workers: int | None = 1, devices: int = 1,
                      tree: bool = False) -> PartitionOptions:
    """The PartitionOptions from the result of `given_options`.

    By default the blocks of the workers that share a device fit it together, and a city that is cut
    already keeps its steps.

    Parameters
    ----------
    workers : None: as many as share the devices well.
    devices : the number of devices that the workers use.
    """
    from clsplat.city.cut import requested_of
    from clsplat.city.forecast import (
        expected_gaussians,
        facts_of_whole,
        gaussians_that_fit,
        trains_jointly,
    )
    facts, photos = facts_of_whole(scene, options)
    expected, fit = expected_gaussians(facts, options), gaussians_that_fit(device, options)
    number = workers or devices
    recorded = requested_of(city) if city.has_partition else {}
    chosen = PartitionOptions(**{
        **{name: recorded[name] for name in STEPS if name in recorded}, **given,
        "expected": expected,
        "block_gaussians": given.get("block_gaussians") or max(
            LEAST_GAUSSIANS, int(fit / max(1, number / devices))),
        "least_blocks": min(number, max(1, expected // LEAST_GAUSSIANS)), "workers": number})
    if workers is None:
        memory = chosen.trained / chosen.blocks / fit * device.handle.global_mem_size
        chosen = replace(chosen, workers=devices * blocks_sharing(
            device, math.ceil(chosen.blocks / devices), memory))
    return chosen.decided(not (recorded or tree) and chosen.several and expected <= fit
                          and trains_jointly(facts, photos, options))


def _beside(scene: Path) -> Path:
    """The default folder of a city, beside SCENE."""
    if scene.name in ("", ".."):
        scene = Path(os.path.abspath(scene))
    if not scene.name:
        raise InputError(f"{scene}: has no name; name the folder of the city with --output")
    return scene.with_name(scene.name + ".city")


def _devices(text: str, workers: int | None, scheduler: str) -> tuple[str, ...]:
    """The names in --device 0,1; InputError where some would not be used."""
    if not text:
        return ()
    names = tuple(text.split(","))
    if not all(names):
        raise InputError(f"--device {text}: expects names separated by commas, such as 0,1")
    if len(names) > 1 and scheduler:
        raise InputError(f"--device {text}: with --scheduler, CLSPLAT_DEVICE on each worker names "
                         "its device; name one device here, for the coarse run")
    if workers is not None and len(names) > max(1, workers):
        raise InputError(f"--device {text}: names {len(names)} devices for --workers {workers}; "
                         f"use --workers {len(names)}, or name fewer")
    return names
