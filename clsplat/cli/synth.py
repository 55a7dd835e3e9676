"""`clsplat synth`: make a procedural city scene with known geometry."""

from __future__ import annotations

from pathlib import Path

import click

from clsplat.errors import InputError


def _pair(context: click.Context, option: click.Parameter, text: str) -> tuple[int, int]:
    """Two whole numbers from a text such as 320x240."""
    try:
        first, second = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise InputError(f"--{option.name} {text}: expects two whole numbers, such as "
                         f"{option.default}") from None
    return first, second


@click.command()
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="Folder of the new scene.")
@click.option("--blocks", default="2x2", show_default=True, callback=_pair,
              help="Number of city blocks along x and y.")
@click.option("--views", default=32, show_default=True, help="Number of photos.")
@click.option("--size", default="320x240", show_default=True, callback=_pair,
              help="Width and height of a photo, pixels.")
@click.option("--seed", default=0, show_default=True,
              help="Seed of the city; the same seed gives the same bytes.")
def synth(output: Path, blocks: tuple[int, int], views: int, size: tuple[int, int], seed: int
          ) -> None:
    """Make a synthetic city scene with known geometry.

    It has photos, a COLMAP model and the true geometry.
    """
    from clsplat.cli.progress import Progress
    from clsplat.synth.write import synthesise
    with Progress() as progress:
        photos, points, observations = synthesise(
            output, blocks, views, width=size[0], height=size[1], seed=seed,
            progress=lambda done, total: progress.count("photo", done, total))
    click.echo(f"{output}: {photos} views of {size[0]} x {size[1]}, {points:,} points, "
               f"{observations:,} observations")
