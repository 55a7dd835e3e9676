"""`clsplat compare`: runs against each other."""

import math
from pathlib import Path

import click

from clsplat.cli.flags import FiniteRange
from clsplat.errors import InputError


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Folder for compare.html, .png and .json; default: what RUNS have in common.")
@click.option("--psnr", "levels", multiple=True, type=FiniteRange(),
              help="Colour-corrected PSNR, dB, whose training times to list; repeatable; default: "
              "three chosen from the data.")
def compare(runs, output, levels):
    """Draw the error of RUNS, run folders or folders of them, against training time.

    Runs that differ in nothing but their seed are drawn as one, with its spread.
    """
    for level in levels:
        if not math.isfinite(level):
            raise InputError(f"--psnr {level}: wants a number of dB, such as 28.5")
    from clsplat.report.compare import write_comparison
    text, page = write_comparison(runs, output, levels)
    click.echo(f"{text}\n\npage: {click.format_filename(page)}")
