"""`clsplat compare`: comparisons of runs."""

from __future__ import annotations

from pathlib import Path

import click

from clsplat.cli.flags import FiniteRange


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Folder for compare.html and compare.json; default: the common folder of RUNS.")
@click.option("--psnr", "levels", multiple=True, type=FiniteRange(min=0),
              help="Colour-corrected PSNR, dB, whose training times to list; repeatable; default: "
              "three chosen from the data.")
def compare(runs: tuple[Path, ...], output: Path | None, levels: tuple[float, ...]) -> None:
    """Plot the error of RUNS over training time.

    RUNS are run folders, or folders with several runs. Runs that differ only by seed are drawn as
    one, with their spread.
    """
    from clsplat.report.compare import write_comparison
    text, page = write_comparison(runs, output, levels)
    click.echo(f"{text}\n\npage: {click.format_filename(page)}")
