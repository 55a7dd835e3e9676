"""`clsplat city` and its stages `partition`, `block` and `merge`: large scenes, block by block."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.cli import flags
from clsplat.cli.train import ending
from clsplat.errors import InputError, Interrupted
from clsplat.partition.options import PartitionOptions

if TYPE_CHECKING:
    from clsplat.cities.city import Shown
    from clsplat.cities.run import Finished
    from clsplat.io.runs.city import CityFolder

BLOCKS: dict[str, Any] = {"cls": flags.SectionedOption, "section": "Blocks"}
TREE_HELP = (
    "Merge into a tree of levels of detail, CITY/point_cloud.tree, which `render`, `film` "
    "and `view` read in parts, in place of point_cloud.ply: one block at a time is in "
    "memory, and nothing is evaluated."
)


@click.command(cls=flags.TrainingCommand)
@click.argument("scene", type=flags.PATH)
@flags.training_flags
@flags.flags_of(PartitionOptions)
@click.option("-o", "--output", type=flags.PATH, **BLOCKS, help="Folder of the city; default: SCENE.city.")
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    **BLOCKS,
    help="Number of blocks that are "
    "trained at a time on this machine; --grid auto makes at least as many blocks. "
    "Default: one for each device, or as many as share a GPU well: up to four, with four "
    "cores for each, and blocks that fit its memory together. With --scheduler: for how "
    "many workers to cut.",
)
@click.option(
    "--scheduler",
    default="",
    **BLOCKS,
    help="Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers train the blocks.",
)
@click.option(
    "--fill", is_flag=True, **BLOCKS, help="Where a block fails, use the coarse model's gaussians; the report says so."
)
@click.option(
    "--against",
    type=flags.PATH,
    **BLOCKS,
    help="A run of the whole scene, or its PLY, as the reference for seams, in place of the coarse model.",
)
@click.option("--tree", is_flag=True, **BLOCKS, help=TREE_HELP)
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
@click.pass_context
def city(
    ctx: click.Context,
    /,
    scene: Path,
    output: Path | None,
    workers: int | None,
    scheduler: str,
    fill: bool,
    against: Path | None,
    tree: bool,
    quiet: bool,
    **_options: object,
) -> None:
    """Train a large SCENE in blocks, and merge them.

    The stages are a coarse run, partition, training of the blocks, merge and evaluation. After any
    failure, the same command continues. The folder is a run like any other, for `clsplat eval`,
    `render` and `compare`. For several devices, use --device 0,1.
    """
    from clsplat.cities.run import city as train_city
    from clsplat.io.runs.city import CityFolder
    from clsplat.io.scenes.read import read_scene
    from clsplat.options import resolve

    given = {**flags.config_options(ctx), **flags.given_options(ctx)}
    devices = _devices(given.pop("device", ""), workers, scheduler)
    options = resolve({}, {**given, **({"device": devices[0]} if devices else {})})
    data, folder = read_scene(scene, options.images), CityFolder(output or _beside(scene))
    finished = train_city(
        data,
        options,
        folder.path,
        workers=workers,
        devices=devices,
        partition=flags.given_options(ctx, PartitionOptions),
        scheduler=scheduler,
        fill=fill,
        against=against,
        tree=tree,
        shown=_shown(quiet, options.stop_at),
    )
    _print(folder, finished, against, quiet)


@click.command("partition", cls=flags.SectionedCommand)
@click.argument("folder", metavar="CITY", type=flags.PATH)
@flags.flags_of(PartitionOptions)
@flags.moved_scene_flag
@click.pass_context
def partition_command(ctx: click.Context, /, folder: Path, scene: Path | None, **_options: object) -> None:
    """Cut the scene of CITY into blocks.

    Needs a finished coarse run in CITY/coarse. Writes partition.json, the map partition.png, and a
    folder for each block.
    """
    from clsplat.cities.run import cut_city
    from clsplat.io.runs.city import CityFolder

    city = CityFolder(folder)
    click.echo(cut_city(city, flags.given_options(ctx, PartitionOptions), scene))
    click.echo(f"{city.picture}")


@click.command()
@click.argument("folder", type=flags.PATH)
@click.option("--device", envvar=flags.DEVICE, help="As for `clsplat train`; default: that of the city.")
@click.option("--stop-at", type=click.IntRange(min=1), help="Stop after this step.")
@click.option(
    "--wait",
    type=flags.FiniteRange(0, 86400),
    default=0,
    show_default=True,
    help="Seconds to wait for another process that trains this block.",
)
@click.option("--alone", is_flag=True, help="Do without the exchanges with other blocks that are left.")
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
def block(folder: Path, device: str | None, stop_at: int | None, wait: float, alone: bool, quiet: bool) -> None:
    """Train the block of a city in FOLDER.

    FOLDER is a CITY/blocks/NNN; the run is written to run/ in it. Continues from the last
    checkpoint, and does nothing if the block is finished. It needs only the folder and the photos,
    so it runs on any machine: `clsplat city` calls it, and so may the queue of a cluster.

    Where blocks exchange gaussians (--exchanges of `clsplat partition`), it ends at an exchange for
    which another block has not come far enough; the same command then goes on.
    """
    from clsplat.cities.block import block_options, train_block
    from clsplat.cli.progress import Progress
    from clsplat.io.runs.city import BlockFolder

    city_block = BlockFolder(folder)
    city_block.check()
    given: dict[str, Any] = {"device": device, "stop_at": stop_at}
    changes = {name: value for name, value in given.items() if value}
    try:
        last = block_options(city_block, **changes).stop_at
        with nullcontext() if quiet else Progress(last) as progress:
            state = train_block(city_block, None, progress, alone=alone, patience=wait, **changes)
    except Interrupted:
        raise Interrupted(f"{folder}: stopped, its state is saved; the same command continues") from None
    if not quiet:
        click.echo(f"{city_block.run}: {state}")


@click.command()
@click.argument("folder", metavar="CITY", type=flags.PATH)
@click.option(
    "--fill",
    is_flag=True,
    help="Use the coarse model's gaussians where a block is missing or unfinished; the report says so.",
)
@click.option(
    "--against",
    type=flags.PATH,
    help="A run of the whole scene, or its PLY, as the reference for seams, in place of the coarse model.",
)
@click.option("--tree", is_flag=True, help=TREE_HELP)
@flags.device_flag
@flags.moved_scene_flag
@click.pass_context
def merge(
    ctx: click.Context, folder: Path, fill: bool, against: Path | None, tree: bool, device: str, scene: Path | None
) -> None:
    """Merge the finished blocks of CITY into one model.

    That may then be trained as a whole, and is evaluated on the held-out views. If blocks are
    missing, the command lists them and ends with exit code 2.
    """
    from clsplat.cities.city import City
    from clsplat.cities.merge import reference_file
    from clsplat.cities.run import merge_city
    from clsplat.io.runs.city import CityFolder
    from clsplat.io.runs.run import RunFolder

    city = CityFolder(folder)
    city.check_there()
    reference = reference_file(against, tree)
    ctx.with_resource(RunFolder(folder).locked())
    whole = City.open(city, scene, device)
    finished = merge_city(whole, fill, reference, tree, _shown(False, whole.options.stop_at))
    _print(city, finished, against, quiet=False)


def _shown(quiet: bool, stop_at: int) -> Shown:
    """What prints the stages of a city, and what fails, and unless `quiet` all else."""
    from clsplat.cities.city import Shown
    from clsplat.cli.progress import Progress
    from clsplat.training.progress import SilentProgress

    class Printed(Shown):
        def stage(self, title: str) -> AbstractContextManager[SilentProgress | None]:
            return super().stage(title) if quiet else Progress(stop_at, title=title)

        def line(self, text: str) -> None:
            if not quiet:
                click.echo(text)

        def failure(self, text: str) -> None:
            click.echo(text, err=True)

    return Printed()


def _print(folder: CityFolder, finished: Finished, against: Path | None, quiet: bool) -> None:
    """Print what a finished city is."""
    from clsplat.cities.merge import merge_record
    from clsplat.cli.evaluate import summary
    from clsplat.io.models.tree import TREE
    from clsplat.report.city import seam_table, share_table

    merged, evaluated = finished.merged, finished.evaluated
    if against and evaluated and not finished.seams:
        click.echo("--against: not used, since a single block has no seams", err=True)
    if quiet:
        return
    click.echo(share_table(merge_record(folder) if evaluated else merged.record()).text())
    blocks = f"{len(merged.shares)} block{'s' * (len(merged.shares) != 1)}"
    if not evaluated:
        click.echo(f"{folder.path / TREE}: {merged.count:,} gaussians of {blocks}")
        return
    if finished.seams:
        click.echo(seam_table(finished.seams).text())
    if finished.scores:
        click.echo(summary(finished.scores))
    click.echo(f"{folder.path}: {merged.count:,} gaussians of {blocks}")
    click.echo("\n".join(ending(folder.path)))


def _beside(scene: Path) -> Path:
    """The default folder of a city, beside SCENE."""
    scene = scene if scene.name not in ("", "..") else Path(os.path.abspath(scene))
    return scene.with_name(scene.name + ".city")


def _devices(text: str, workers: int | None, scheduler: str) -> tuple[str, ...]:
    """The names in --device 0,1; InputError where some would not be used."""
    if not text:
        return ()
    names = tuple(text.split(","))
    if not all(names):
        raise InputError(f"--device {text}: expects names separated by commas, such as 0,1")
    if len(names) > 1 and scheduler:
        raise InputError(
            f"--device {text}: with --scheduler, CLSPLAT_DEVICE on each worker names "
            "its device; name one device here, for the coarse run"
        )
    if workers is not None and len(names) > max(1, workers):
        raise InputError(
            f"--device {text}: names {len(names)} devices for --workers {workers}; "
            f"use --workers {len(names)}, or name fewer"
        )
    return names
