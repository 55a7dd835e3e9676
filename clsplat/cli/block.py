"""`clsplat block`: one block of a city, trained to its end."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import click

from clsplat.cli.flags import DEVICE, FiniteRange
from clsplat.errors import Interrupted


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--device", envvar=DEVICE,
              help="As for `clsplat train`; default: that of the city.")
@click.option("--stop-at", type=click.IntRange(min=1), help="Stop after this step.")
@click.option("--wait", type=FiniteRange(0, 86400), default=0, show_default=True,
              help="Seconds to wait for another process that trains this block.")
@click.option("--alone", is_flag=True, help="Do without the exchanges with other blocks that are "
              "left.")
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
def block(folder: Path, device: str | None, stop_at: int | None, wait: float, alone: bool,
          quiet: bool) -> None:
    """Train the block of a city in FOLDER.

    FOLDER is a CITY/blocks/NNN; the run is written to run/ in it. Continues from the last
    checkpoint, and does nothing if the block is finished. It needs only the folder and the photos,
    so it runs on any machine: `clsplat city` calls it, and so may the queue of a cluster.

    Where blocks exchange gaussians (--exchanges of `clsplat partition`), it ends at an exchange for
    which another block has not come far enough; the same command then goes on.
    """
    from clsplat.cities.block import BlockTraining
    from clsplat.cli.progress import Progress
    from clsplat.io.runs.city import BlockFolder
    city_block = BlockFolder(folder)
    city_block.check()
    changes = {key: value for key, value in (("device", device), ("stop_at", stop_at)) if value}
    try:
        training = BlockTraining(city_block, changes=changes)
        with nullcontext() if quiet else Progress(training.options.stop_at) as progress:
            state = training.run(progress, alone=alone, patience=wait)
    except Interrupted:
        raise Interrupted(f"{folder}: stopped, its state is saved; the same command continues"
                          ) from None
    if not quiet:
        click.echo(f"{city_block.run}: {state}")
