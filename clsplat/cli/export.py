"""`clsplat export`: a run's gaussians in a format that other programs open."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.cli.flags import FiniteRange
from clsplat.errors import InputError

if TYPE_CHECKING:
    from clsplat.evaluation.run import Run

FORMATS = {".ply": "the format of Kerbl et al. 2023, which splat viewers open"}


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="File to write; its suffix selects the format (.ply).")
@click.option("--sh-degree", type=click.Choice(("all", "auto", "0", "1", "2", "3")), default="all",
              show_default=True, help="Highest degree of the spherical harmonics to write; auto: "
              "the lowest that costs the held-out views less than --sh-cost.")
@click.option("--sh-cost", type=FiniteRange(min=0), default=0.05, show_default=True,
              help="Loss of PSNR, dB, that --sh-degree auto allows.")
@click.option("--device", default="auto", show_default=True,
              help="For --sh-degree auto: as for `clsplat eval`.")
@click.option("--scene", type=click.Path(path_type=Path),
              help="For --sh-degree auto: where the scene is now, if it was moved.")
def export(run: Path, output: Path, sh_degree: str, sh_cost: float, device: str,
           scene: Path | None) -> None:
    """Write the gaussians of RUN to a file for other programs.

    They are in the world coordinates of the scene. Gaussians that are invisible in every view, with
    an opacity below one step of 8 bits, are left out.
    """
    if output.suffix.lower() not in FORMATS:
        known = "; ".join(f"{suffix} ({what})" for suffix, what in FORMATS.items())
        raise InputError(f"{output}: unknown suffix '{output.suffix}'; known: {known}")
    from clsplat.evaluation.run import Run
    from clsplat.export.prune import alive
    from clsplat.io.atomic import replacing
    from clsplat.io.ply import write_part
    opened = Run.open(run)
    source = opened.folder.model_path
    if output.exists() and output.samefile(source):
        raise InputError(f"{output}: is the run's own model; name another file")
    gaussians = opened.finished_model  # reads all of it: a damaged model is not passed on
    keep, degree = alive(gaussians), gaussians.sh_degree
    if sh_degree == "auto":
        degree = _measured_degree(opened, device, sh_cost, scene)
    elif sh_degree != "all":
        degree = int(sh_degree)
    if not keep.any():
        what = f"all {len(keep):,} gaussians are too faint to be seen" if len(keep) else "is empty"
        raise InputError(f"{source}: {what}, so nothing is left to write; train longer, or see the "
                         "report of the run")
    if keep.all() and degree == gaussians.sh_degree:
        with open(source, "rb") as model, replacing(output) as copy:
            shutil.copyfileobj(model, copy)
    else:
        write_part(output, source, keep, degree)
    click.echo(f"{output}: {keep.sum():,} gaussians, spherical harmonics to degree {degree}; "
               f"{len(keep) - keep.sum():,} invisible ones are left out")


def _measured_degree(opened: Run, device: str, cost: float, scene: Path | None) -> int:
    from clsplat.device import choose_device
    from clsplat.export.prune import needed_sh_degree
    degree, scores = needed_sh_degree(opened, choose_device(device), cost, scene)
    click.echo("held-out PSNR, dB: " + ", ".join(
        f"degree {number} {score:.3f}" for number, score in enumerate(scores)))
    return degree
