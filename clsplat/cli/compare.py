"""`clsplat compare`: runs against each other."""

from pathlib import Path

import click

from clsplat.cli.flags import FiniteRange


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
    from clsplat.report.compare import write_comparison
    text, page = write_comparison(runs, output, levels)
    click.echo(f"{text}\n\npage: {click.format_filename(page)}")
