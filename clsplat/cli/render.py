"""`clsplat render`: pictures of a model from a scene's cameras."""

from pathlib import Path

import click

from clsplat.cli.flags import FiniteRange
from clsplat.errors import InputError


@click.command()
@click.argument("model", metavar="RUN_OR_PLY", type=click.Path(path_type=Path))
@click.option("--scene", type=click.Path(path_type=Path),
              help="Scene whose cameras to use; a run knows its own.")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="Folder for the PNG files.")
@click.option("--views", type=click.Choice(("all", "test", "train")), default="all",
              show_default=True, help="Which views of the scene.")
@click.option("--beside", is_flag=True, help="Put each render beside its photo; with --lod, "
              "beside the full model's render and what both are compared with.")
@click.option("--lod", is_flag=True, help="Draw what is far away from the levels of detail of "
              "a run trained with --snapshots, and compare with the full model.")
@click.option("--lod-bias", type=FiniteRange(0, 1e6, min_open=True), default=1.0,
              show_default=True, help="With --lod: levels as coarse as if all were so many "
              "times as far away.")
@click.option("-r", "--downscale", type=FiniteRange(min=1), default=1.0, show_default=True,
              help="With --lod: pictures so many times smaller, as if seen from as far.")
@click.option("--away", type=FiniteRange(0, 1e6), default=0.0, show_default=True,
              help="With --lod: move each camera back by so many times its distance to the scene.")
@click.option("--device", default="auto", show_default=True,
              help="auto, cpu, gpu, a number of `clsplat devices`, or part of a name.")
def render(model, scene, output, views, beside, lod, lod_bias, downscale, away, device):
    """Render a run or a PLY file from the cameras of a scene."""
    from clsplat.device import choose_device
    if lod:
        from clsplat.city.lod import compare_views
        records = compare_views(model, scene, output, choose_device(device), views=views,
                                beside=beside, bias=lod_bias, away=away, downscale=downscale)
        count = _tell(records, "the full model, 16 samples a pixel" if away else "the photo")
    else:
        for flag, given in (("--lod-bias", lod_bias != 1), ("--downscale", downscale != 1),
                            ("--away", away)):
            if given:
                raise InputError(f"{flag}: means nothing without --lod; add it, or leave this out")
        from clsplat.evaluation.views import render_views
        count = render_views(model, scene, output, choose_device(device), views=views,
                             beside=beside)
    click.echo(f"{count} pictures: {output}")


def _tell(records, reference):
    """Print the table of `lod.compare_views`, a line a view as they come; returns how many."""
    columns = ("gaussians", "share", "psnr_full", "psnr", "full_psnr", "seconds", "full_seconds")
    rows = []
    for record in records:
        if not rows:
            click.echo(
                f"dB against the full model's render; of LoD and full model against {reference}; "
                f"seconds of both\n{'view':<20}{'gaussians':>11}{'share':>8}"
                f"{'dB':>8}{'LoD dB':>8}{'full dB':>8}{'LoD s':>8}{'full s':>8}")
        rows.append([record[column] for column in columns])
        _line(record["name"], rows[-1])
    _line("mean", [sum(column) / len(rows) for column in zip(*rows)])
    return len(rows)


def _line(name, values):
    formats = ("11,.0f", "8.1%", "8.2f", "8.2f", "8.2f", "8.3f", "8.3f")
    click.echo(f"{name:<20}" + "".join(f"{value:>{how}}" for value, how in zip(values, formats)))
