"""`clsplat export`: a run's gaussians in a format that other programs open."""

from functools import partial
from pathlib import Path

import click

from clsplat.cli.flags import PATH, check_free, device_flag, everything_flag
from clsplat.errors import DeviceError, InputError


@click.command()
@click.argument("run", type=PATH)
@click.option(
    "-o",
    "--output",
    required=True,
    type=PATH,
    help="File to write; its suffix selects "
    "the format: .ply, .sog, .spz, .glb, OpenUSD as .usdz, .usdc or .usda, points as "
    ".las or .laz, or .html, a page for the browser. With levels of detail: a name "
    "without a suffix, a folder of 3D Tiles; FOLDER/lod-meta.json, Streamed SOG.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@click.option(
    "--upright",
    is_flag=True,
    help="Turn the model so that up is -y, as most viewers expect. It then no longer fits the scene's cameras.",
)
@click.option(
    "--sh-degree",
    type=click.IntRange(0, 3),
    default=3,
    show_default=True,
    help="Highest degree of the spherical harmonics to write.",
)
@click.option(
    "--spz-version",
    type=click.Choice(["3", "4"]),
    help="For .spz: the version of the format; 4 needs the extra spz, and fewer programs read it. Default: 3.",
)
@everything_flag
@click.option("--scene", type=PATH, help="For a page: where the scene is now, if it was moved.")
@click.option("--title", default="", help="For a page: its title; default: the name of the run.")
@click.option(
    "--no-photos",
    is_flag=True,
    help="For a page: leave out the small copies of the photos, which take up to 11 MiB of it.",
)
@device_flag
def export(
    run: Path,
    output: Path,
    overwrite: bool,
    upright: bool,
    sh_degree: int,
    spz_version: str | None,
    everything: bool,
    scene: Path | None,
    title: str,
    no_photos: bool,
    device: str,
) -> None:
    """Write the gaussians of RUN to a file for other programs.

    They are in the world coordinates of the scene; in .las and .laz, in map coordinates if it is
    georeferenced. Gaussians that are invisible in every view, with an opacity below one step of 8
    bits, and degrees of spherical harmonics that are zero everywhere are left out; of a page also
    gaussians at places that fewer than two photos show. The device only draws what a page shows
    while it loads.
    """
    from clsplat.apps.models import scene_of, supported, write_run_model
    from clsplat.apps.page_pictures import photos_of_page, poster_of
    from clsplat.apps.streamed_sog import INDEX, write_run_sog
    from clsplat.apps.tiles import write_run_tiles
    from clsplat.cli.progress import Progress
    from clsplat.edit.select import alive, selected, used_sh_degree
    from clsplat.evaluation.run import Run
    from clsplat.io.models.formats import format_of
    from clsplat.report.model_page import write_run_page

    is_page, is_folder = output.suffix.lower() == ".html", not output.suffix
    is_streamed = output.name == INDEX
    if is_streamed and not output.parent.name:
        raise InputError(f"{output}: fills a folder; name a new one, such as site/{INDEX}")
    if upright and (is_page or is_folder):
        raise InputError("--upright: pages and 3D Tiles are upright; leave it out")
    is_points = not (is_page or is_folder or is_streamed) and format_of(output).is_points
    if everything and not is_page:
        raise InputError("--everything: is for pages, other formats have all; leave it out")
    for flag, given, fits, what in (
        ("--title", title, is_page, "pages"),
        ("--no-photos", no_photos, is_page, "pages"),
        ("--spz-version", spz_version, output.suffix.lower() == ".spz", ".spz"),
    ):
        if given and not fits:
            raise InputError(f"{flag}: is for {what}; leave it out")
    opened = Run.open(run)
    source = opened.folder.model_path
    if output.exists() and output.samefile(source):
        raise InputError(f"{output}: is the run's own model; name another file")
    if not (is_folder or is_streamed):
        check_free(output, overwrite)
    with Progress() as progress:
        progress.phase(f"reading {run}")
        gaussians = opened.finished_model  # reads all of it: a damaged model is not passed on
        keep = alive(gaussians)
        degree = 0 if is_points else min(used_sh_degree(gaussians), sh_degree)
        if not keep.any():
            raise InputError(
                f"{source}: none of its {len(keep):,} gaussians can be seen, so "
                "nothing is left to write; train longer, or see the run's report"
            )
        data = scene_of(opened, scene) if is_page else None
        photos = photos_of_page(data, not no_photos, progress.count) if data else []
        if is_page and not photos:
            progress.message(
                f"{run}: its scene is not there, so no photo is shown, and gaussians "
                "that fewer than two photos support are kept too; name it with "
                "--scene"
            )
        visible = int(keep.sum())
        if photos and not everything:
            keep[keep] = supported(selected(gaussians, keep), [each.camera for each in photos])
        progress.phase(f"writing {output}")
        part = selected(gaussians, keep).with_sh_degree(degree)
        if is_folder:
            tiles = write_run_tiles(output, opened, part, partial(progress.count, "tile"))
        elif is_streamed:
            write_run_sog(output.parent, opened, part, upright, partial(progress.count, "part"))
        elif is_page:
            try:
                poster = poster_of(opened, part, device)
            except DeviceError as error:
                poster = b""
                progress.message(f"the page has no picture while it loads: {error}")
            progress.phase(f"writing {output}")
            write_run_page(output, opened, part, photos, title=title, poster=poster, progress=progress.count)
        else:
            write_run_model(output, opened, part, upright, int(spz_version or 0))
    if is_folder:
        click.echo(f"{output}/tileset.json: {tiles:,} {'tile' if tiles == 1 else 'tiles'}")
    left_out = "".join(
        f"; left out as {what}: {count:,}"
        for what, count in (
            ("invisible", len(keep) - visible),
            ("supported by fewer than two photos", visible - int(keep.sum())),
        )
        if count
    )
    click.echo(f"{output}: {keep.sum():,} gaussians, spherical harmonics to degree {degree}{left_out}")
