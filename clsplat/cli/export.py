"""`clsplat export`: a run's gaussians in a format that other programs open."""

import shutil
from pathlib import Path

import click

from clsplat.errors import InputError

FORMATS = {".ply": "the format of Kerbl et al. 2023, which splat viewers open"}


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="File to write; its suffix selects the format (.ply).")
def export(run, output):
    """Write the gaussians of RUN, in the world coordinates of its scene, to one file."""
    if output.suffix.lower() not in FORMATS:
        known = "; ".join(f"{suffix} ({what})" for suffix, what in FORMATS.items())
        raise InputError(f"{output}: no format has the suffix '{output.suffix}'; known: {known}")
    from clsplat.io.atomic import replacing
    from clsplat.io.run import MODEL, RunFolder
    folder = RunFolder.open(run)
    count = folder.load_model().count  # reads all of it: a damaged model is not passed on
    with open(folder.path / MODEL, "rb") as model, replacing(output) as copy:
        shutil.copyfileobj(model, copy)
    click.echo(f"{output}: {count:,} gaussians")
