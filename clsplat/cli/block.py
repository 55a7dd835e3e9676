"""`clsplat block`: one block of a city, trained to its end."""

from contextlib import nullcontext
from pathlib import Path

import click

from clsplat.cli.flags import DEVICE, FiniteRange
from clsplat.errors import Interrupted


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--device", envvar=DEVICE,
              help="As for `clsplat train`, instead of what the city was given.")
@click.option("--stop-at", type=click.IntRange(min=1), help="Stop after this step.")
@click.option("--wait", type=FiniteRange(0, 86400), default=0, show_default=True,
              help="Seconds to wait for another process that trains this block.")
@click.option("-q", "--quiet", is_flag=True, help="No progress line.")
def block(folder, device, stop_at, wait, quiet):
    """Train the block in FOLDER, a CITY/blocks/NNN, into its folder run/.

    Goes on from the last checkpoint, and does nothing where the block is finished. It needs nothing
    but its folder and the photos, so it runs anywhere: `clsplat city` calls it, and so may a
    cluster's queue.
    """
    from clsplat.io.city import BlockFolder
    from clsplat.training.block import block_options, train_block
    there = BlockFolder(folder)
    there.check()
    changes = {"device": device, "stop_at": stop_at}
    options = block_options(there, **{key: value for key, value in changes.items() if value})
    try:
        with nullcontext() if quiet else _progress(options) as progress:
            trained = train_block(there, options, progress, wait)
    except Interrupted:
        raise Interrupted(f"{folder}: stopped, its state is saved; the same command goes on"
                          ) from None
    if not quiet:
        click.echo(f"{there.run}: {'finished' if trained else 'was finished before'}")


def _progress(options):
    from clsplat.cli.progress import Progress
    return Progress(options.stop_at)
