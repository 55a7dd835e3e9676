"""`clsplat city` and its stages `partition` and `merge`: large scenes, block by block."""

import os
from contextlib import nullcontext
from pathlib import Path

import click

from clsplat.cli.flags import flags_of, given_options, training_flags
from clsplat.cli.sections import SectionedCommand, SectionedOption
from clsplat.errors import InputError, Interrupted
from clsplat.partition.options import LEAST_GAUSSIANS, PartitionOptions

BLOCKS = {"cls": SectionedOption, "section": "Blocks"}


@click.command(cls=SectionedCommand)
@click.argument("scene", type=click.Path(path_type=Path))
@training_flags
@flags_of(PartitionOptions)
@click.option("-o", "--output", type=click.Path(path_type=Path), **BLOCKS,
              help="Folder of the city; SCENE.city where left out.")
@click.option("--workers", default=1, show_default=True, **BLOCKS,
              help="Blocks trained at a time on this machine; a chosen grid has at least as many.")
@click.option("--scheduler", default="", **BLOCKS, help="Address of a Dask scheduler, such as "
              "tcp://10.0.0.1:8786, whose workers train the blocks.")
@click.option("--fill", is_flag=True, **BLOCKS, help="Where a block fails, take the coarse model's "
              "gaussians; the report says so.")
@click.option("--against", type=click.Path(path_type=Path), **BLOCKS, help="A run of the whole "
              "scene, or its PLY, that seams are measured by, in place of the coarse model.")
@click.option("-q", "--quiet", is_flag=True, help="No progress line.")
@click.pass_context
def city(ctx, scene, output, workers, scheduler, fill, against, quiet, **_):
    """Train SCENE in blocks: coarse run, partition, blocks, merge, evaluation.

    Run again after any failure, it goes on where it was. The folder is a run like any other, for
    `clsplat eval`, `render` and `compare`. Several devices: --device 0,1 with --workers 2.
    """
    from clsplat.city.finish import reference_file
    from clsplat.city.forecast import block_table
    from clsplat.city.stages import (
        begin,
        cut_into_blocks,
        train_all_blocks,
        train_coarse,
    )
    from clsplat.device import choose_device
    from clsplat.distribute import check_scheduler, check_workers
    from clsplat.io.city import CityFolder
    from clsplat.io.run import RunFolder
    from clsplat.io.scenes import read_scene
    from clsplat.options import resolve
    from clsplat.training.photos import size_note
    given = given_options(ctx)
    devices = _devices(given.pop("device", ""), workers, scheduler)
    options = resolve({}, {**given, **({"device": devices[0]} if devices else {})})
    check_workers(workers)
    against = reference_file(against)
    if options.init != "sfm" or options.coarse:
        raise InputError("--init, --coarse: the coarse run begins a city, blocks begin with it; "
                         "leave them out")
    data = read_scene(scene, options.images)
    folder = CityFolder(output or _beside(scene))
    device = [choose_device(name, form=options.form) for name in devices or (options.device,)][0]
    wanted = partition_options(given_options(ctx, PartitionOptions), data, options, device, workers)
    if scheduler and not RunFolder(folder.coarse).has_model:
        check_scheduler(scheduler)
    if not folder.has_record:
        folder.check_free()
    ctx.with_resource(RunFolder(folder.path).locked())
    begin(folder, data, options)
    if not quiet and (note := size_note(data.views, options)):
        click.echo(note)

    def shown(title):
        return nullcontext() if quiet else _progress(options, title)

    try:
        with shown("coarse run") as progress:
            train_coarse(folder, data, options, device, progress)
        _, counts = cut_into_blocks(folder, data, options, wanted, device)
        if not quiet:
            click.echo(block_table(folder, device, counts).text())
        outcomes = train_all_blocks(
            folder, data, options, device, told=_told(quiet), began=_began(quiet or not (
                scheduler or workers > 1)), workers=workers, scheduler=scheduler, devices=devices,
            progress=shown)
    except Interrupted:
        raise Interrupted(f"{folder.path}: stopped, the state is saved; the same command goes on"
                          ) from None
    failed = [outcome for outcome in outcomes if not outcome.ok]
    for outcome in failed:
        click.echo(f"block {outcome.task.name} failed on {outcome.worker}: {outcome.message}",
                   err=True)
    _finish(folder, data, options, device, fill, against, quiet)


@click.command("partition", cls=SectionedCommand)
@click.argument("folder", metavar="CITY", type=click.Path(path_type=Path))
@flags_of(PartitionOptions)
@click.option("--scene", type=click.Path(path_type=Path), **BLOCKS, help="Where the scene is now, "
              "if it was moved.")
@click.pass_context
def partition_command(ctx, folder, scene, **_):
    """Cut the scene of CITY into blocks, by the coarse run in CITY/coarse.

    Writes partition.json, partition.geojson, the map partition.png, and a folder a block.
    """
    from clsplat.city.forecast import block_table
    from clsplat.city.stages import begin_from_coarse, cut_into_blocks
    from clsplat.device import choose_device
    from clsplat.io.city import CityFolder
    from clsplat.io.run import RunFolder
    there = CityFolder(folder)
    there.check_there()
    ctx.with_resource(RunFolder(folder).locked())
    data, options = begin_from_coarse(there, scene)
    device = choose_device(options.device, form=options.form)
    wanted = partition_options(given_options(ctx, PartitionOptions), data, options, device)
    _, counts = cut_into_blocks(there, data, options, wanted, device)
    click.echo(block_table(there, device, counts).text())
    click.echo(f"{there.picture}")


@click.command()
@click.argument("folder", metavar="CITY", type=click.Path(path_type=Path))
@click.option("--fill", is_flag=True, help="Take the coarse model's gaussians where a block is "
              "missing, unfinished or starved; the report says so.")
@click.option("--against", type=click.Path(path_type=Path), help="A run of the whole scene, or its "
              "PLY, that seams are measured by, in place of the coarse model.")
@click.option("--device", default="auto", show_default=True,
              help="auto, cpu, gpu, a number of `clsplat devices`, or part of a name.")
@click.option("--scene", type=click.Path(path_type=Path), help="Where the scene is now, if it was "
              "moved.")
@click.pass_context
def merge(ctx, folder, fill, against, device, scene):
    """Merge the finished blocks of CITY to one model, and score it.

    Every gaussian is owned once. Says what is missing, and then ends with exit code 2.
    """
    from clsplat.city.finish import reference_file
    from clsplat.city.stages import begin_from_coarse
    from clsplat.device import choose_device
    from clsplat.io.city import CityFolder
    from clsplat.io.run import RunFolder
    there = CityFolder(folder)
    there.check_there()
    against = reference_file(against)
    ctx.with_resource(RunFolder(folder).locked())
    data, options = begin_from_coarse(there, scene)
    _finish(there, data, options, choose_device(device), fill, against, False)


def _finish(folder, data, options, device, fill, against, quiet):
    from clsplat.city.finish import evaluate_city, merge_city
    from clsplat.cli.evaluate import summary
    from clsplat.report.city import seam_table, share_table
    merged = merge_city(folder, data, options, device, fill)
    scores, seams = evaluate_city(folder, data, options, device, against)
    if against and seams is None:
        click.echo("--against: not used, as one block has no seams", err=True)
    if quiet:
        return
    click.echo(share_table(merged.record()).text())
    if seams:
        click.echo(seam_table(seams).text())
    if scores:
        click.echo(summary(scores))
    click.echo(f"{folder.path}: {merged.gaussians.count:,} gaussians of {len(merged.shares)} "
               "blocks")


def partition_options(given, scene, options, device, workers=1):
    """PartitionOptions of what is given, as from `given_options`; blocks fit the device unless it
    says otherwise."""
    from clsplat.city.forecast import expected_gaussians, gaussians_that_fit
    expected = expected_gaussians(scene, options)
    return PartitionOptions(**{
        **given, "expected": expected,
        "block_gaussians": given.get("block_gaussians") or max(
            LEAST_GAUSSIANS, gaussians_that_fit(device, options)),
        "least_blocks": min(workers, max(1, expected // LEAST_GAUSSIANS))})


def _beside(scene):
    """The folder of a city where none is named: beside SCENE, by its name."""
    if scene.name in ("", ".."):
        scene = Path(os.path.abspath(scene))
    if not scene.name:
        raise InputError(f"{scene}: has no name; say with --output where the city goes")
    return scene.with_name(scene.name + ".city")


def _devices(text, workers, scheduler):
    """The names in --device 0,1; InputError where some would not be used."""
    if not text:
        return ()
    names = tuple(text.split(","))
    if not all(names):
        raise InputError(f"--device {text}: wants names with a comma between two of them, such as "
                         "0,1")
    if len(names) > 1 and scheduler:
        raise InputError(f"--device {text}: with --scheduler, each worker has its own, as "
                         "CLSPLAT_DEVICE says there; name one for the coarse run")
    if len(names) > max(1, workers):
        raise InputError(f"--device {text}: names {len(names)} devices for --workers {workers}; "
                         f"use --workers {len(names)}, or name fewer")
    return names


def _began(quiet):
    def began(name, place):
        if not quiet:
            click.echo(f"{place}: training in blocks/{name}")
    return began


def _told(quiet):
    def told(outcome, place):
        if not quiet:
            click.echo(f"{place} (blocks/{outcome.task.name}): "
                       f"{'finished' if outcome.ok else 'failed'} after {outcome.seconds:.0f} s")
    return told


def _progress(options, title):
    from clsplat.cli.progress import Progress
    return Progress(options.stop_at, title=title)
