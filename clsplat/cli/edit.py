"""`clsplat edit`: crop, clean, merge, decimate and transform finished models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.cli.flags import PATH, FiniteRange, SectionedCommand, SectionedOption, check_free
from clsplat.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from clsplat.apps.edit import Source

CROP: dict[str, Any] = {"cls": SectionedOption, "section": "Crop"}
CLEAN: dict[str, Any] = {"cls": SectionedOption, "section": "Remove gaussians"}
MOVE: dict[str, Any] = {"cls": SectionedOption, "section": "Transform"}
FINITE = FiniteRange()


@click.command(cls=SectionedCommand)
@click.argument("models", metavar="MODEL...", nargs=-1, required=True, type=PATH)
@click.option("-o", "--output", required=True, type=PATH, help="File to write; its suffix selects the format.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@click.option("--scene", type=PATH, help="Scene with the photos for --min-support; default for a run: its own scene.")
@click.option(
    "--box",
    nargs=6,
    type=float,
    **CROP,
    metavar="X0 Y0 Z0 X1 Y1 Z1",
    help="Keep what is in this box; inf and -inf leave a side open.",
)
@click.option(
    "--polygon",
    **CROP,
    metavar="FILE|CORNERS",
    help="Keep what is above or below a polygon on the ground: a GeoJSON file, in the "
    "CRS that it names or in longitude and latitude, or corners such as "
    '"0,0 10,0 10,10".',
)
@click.option("--outside", is_flag=True, **CROP, help="Keep what is outside of the box and the polygon instead.")
@click.option(
    "--min-opacity",
    type=FiniteRange(0, 1),
    default=0.0,
    **CLEAN,
    help="Remove gaussians that are less opaque than this.",
)
@click.option(
    "--max-size",
    type=FiniteRange(min=0, min_open=True),
    **CLEAN,
    help="Remove gaussians whose largest standard deviation, in units of the scene, is more than this.",
)
@click.option(
    "--min-support",
    type=click.IntRange(min=0),
    default=0,
    **CLEAN,
    help="Remove gaussians at places that fewer photos show.",
)
@click.option(
    "--decimate",
    type=FiniteRange(min=0, min_open=True),
    metavar="SHARE|COUNT",
    **CLEAN,
    help="Merge neighbours until this share, such as 0.5, or this number of gaussians is left.",
)
@click.option(
    "--scale",
    type=FiniteRange(min=0, min_open=True),
    default=1.0,
    **MOVE,
    help="Multiply coordinates and sizes by this.",
)
@click.option(
    "--rotate",
    nargs=3,
    type=FINITE,
    **MOVE,
    metavar="X Y Z",
    help="Then rotate by these angles, degrees, about the x, then the y, then the z axis "
    "of the scene; a positive angle about z turns x towards y.",
)
@click.option(
    "--translate",
    nargs=3,
    type=FINITE,
    default=(0.0, 0.0, 0.0),
    **MOVE,
    metavar="X Y Z",
    help="Then move by this, in units of the scene.",
)
def edit(
    models: tuple[Path, ...],
    output: Path,
    overwrite: bool,
    scene: Path | None,
    box: tuple[float, ...] | None,
    polygon: str | None,
    outside: bool,
    min_opacity: float,
    max_size: float | None,
    min_support: int,
    decimate: float | None,
    scale: float,
    rotate: tuple[float, ...] | None,
    translate: tuple[float, ...],
) -> None:
    """Edit finished models, runs or files, and write one file.

    Several models are merged. Each is cropped and cleaned first; then all are decimated and
    transformed together. Coordinates are the original ones of the scene.
    """
    from dataclasses import replace
    from functools import partial

    import numpy as np
    from scipy.spatial.transform import Rotation

    from clsplat.apps.edit import Source, joined
    from clsplat.cli.progress import Progress
    from clsplat.edit.decimate import decimated
    from clsplat.edit.select import used_sh_degree
    from clsplat.io.models.formats import format_of, write_model
    from clsplat.io.models.values import opacities

    format_of(output)
    check_free(output, overwrite)
    if decimate and decimate > 1 and not decimate.is_integer():
        raise InputError(
            f"--decimate {decimate}: neither a share between 0 and 1, such as 0.5, nor a number of gaussians"
        )
    if outside and not (box or polygon):
        raise InputError("--outside: has no effect without --box or --polygon")
    with Progress() as progress:

        def kept(source: Source, keep: NDArray[np.bool_], reason: str) -> Source:
            progress.message(f"{source.path}: {(~keep).sum():,} of {len(keep):,} gaussians {reason}")
            return source.kept(keep)

        sources = []
        for path in models:
            progress.phase(f"reading {path}")
            source = Source.open(path)
            if output.exists() and path.is_file() and output.samefile(path):
                raise InputError(f"{output}: is one of the models; name another file")
            if box or polygon:
                keep = np.ones(source.gaussians.count, bool)
                if box:
                    keep &= source.in_box(box)
                if polygon:
                    keep &= source.in_polygons(polygon)
                source = kept(source, keep ^ outside, f"are {'inside' if outside else 'outside'}")
            if min_opacity:
                source = kept(
                    source, opacities(source.gaussians) >= min_opacity, f"are less opaque than {min_opacity:g}"
                )
            if max_size is not None:
                largest = source.gaussians.log_scales.max(axis=1)
                source = kept(source, largest <= np.log(max_size), f"are larger than {max_size:g}")
            if min_support:
                source = kept(
                    source, source.support(scene) >= min_support, f"lie where fewer than {min_support} photos look"
                )
            sources.append(source)
        source = joined(sources)
        if decimate is not None:
            count = round(decimate * source.gaussians.count) if decimate < 1 else int(decimate)
            source = replace(
                source, gaussians=decimated(source.gaussians, count, partial(progress.count, "merging gaussian"))
            )
        if scale != 1 or rotate or any(translate):
            # about the fixed axes, x first
            turn = Rotation.from_euler("xyz", rotate, degrees=True).as_matrix() if rotate else None
            source = source.transformed(scale, turn, translate)
            if sources[0].notes.georeference and not source.notes.georeference:
                progress.message("the georeference is left out: it does not hold after --scale or --rotate")
        progress.phase(f"writing {output}")
        gaussians = source.gaussians.with_sh_degree(used_sh_degree(source.gaussians))
        notes = source.notes
        write_model(output, gaussians, notes.comments, notes.up, notes.georeference)
    click.echo(f"{output}: {gaussians.count:,} gaussians, spherical harmonics to degree {gaussians.sh_degree}")
