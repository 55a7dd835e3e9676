"""`clsplat sfm`: make a scene from a folder of photos, or from a video."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.cli.flags import PATH, device_flag

if TYPE_CHECKING:
    from clsplat.sfm.reconstruct import SfmOptions

SHOWN = 5  # photos that were not registered


@click.command(short_help="Make a scene from photos or a video.")
@click.argument("photos", type=PATH)
@click.option(
    "-o",
    "--output",
    required=True,
    type=PATH,
    help="Folder of the new scene. The same command continues one that was killed.",
)
@click.option(
    "--masks",
    type=PATH,
    help="Folder of masks NAME.png, dark where a photo shall not "
    "be used. Default: those that are named as such in PHOTOS.",
)
@click.option(
    "--matching",
    type=click.Choice(("auto", "sequence", "all")),
    default="auto",
    show_default=True,
    help="Which pairs of photos are matched: those that follow each other by name, or "
    "all. Default: neighbours by GPS, or photos of similar content.",
)
@click.option(
    "--camera-model",
    default="",
    metavar="NAME",
    help="Camera model of COLMAP, such as OPENCV_FISHEYE. Default: chosen for each camera.",
)
@click.option(
    "--frames",
    type=click.IntRange(3),
    default=200,
    show_default=True,
    help="Number of frames that are taken from a video.",
)
@click.option(
    "--crs",
    default="",
    help="Coordinate reference system of the scene, such as EPSG:25832. Default: the UTM zone of the photos' GPS.",
)
@click.option(
    "--gcp",
    type=PATH,
    help="File of ground control points, to which cameras and points "
    "are adjusted: OpenDroneMap's gcp_list.txt, or CSV.",
)
@click.option(
    "--check-point",
    "check_points",
    multiple=True,
    metavar="NAME",
    help="A point of --gcp that takes no part, but tells the error; may be repeated.",
)
@click.option(
    "--max-features",
    type=click.IntRange(100),
    default=8192,
    show_default=True,
    help="Features of a photo; of more, the largest are kept.",
)
@device_flag
@click.option("--overwrite", is_flag=True, help="Replace a scene that this command has made.")
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
def sfm(
    photos: Path,
    output: Path,
    masks: Path | None,
    matching: str,
    camera_model: str,
    frames: int,
    crs: str,
    gcp: Path | None,
    check_points: tuple[str, ...],
    max_features: int,
    device: str,
    overwrite: bool,
    quiet: bool,
) -> None:
    """Make a scene from PHOTOS: a folder, also with subfolders, or a video.

    Poses and points are found by structure from motion: features and matches on the device, the
    rest by COLMAP's library on the CPU; GPS gives metres and the direction up. The scene is a
    COLMAP folder; its sfm.json tells what was registered, what was not and why.
    """
    from clsplat.sfm.reconstruct import SfmOptions

    options = SfmOptions(masks, matching, camera_model.upper(), frames, crs, gcp, check_points, max_features, device)
    _make_scene(photos, output, options, overwrite, quiet)
    if not quiet:
        click.echo(f"{output}: next, `clsplat train {output} -o RUN`")


def trained_scene(source: Path, output: Path, quiet: bool, overwrite: bool | None) -> Path:
    """The scene that a training reads: what the user gives or, if that is photos or a video, a
    scene OUTPUT_scene beside the run, which is made unless an earlier command has done so.

    Parameters
    ----------
    overwrite : whether the training may replace a run, which is checked before a scene is made,
        since that takes long; None: it continues runs.
    """
    from clsplat.io.runs.run import RunFolder
    from clsplat.io.scenes.read import is_scene
    from clsplat.sfm.photos import has_photos, is_video

    if not is_video(source) and (not has_photos(source) or is_scene(source)):
        return source
    from clsplat.sfm.reconstruct import SfmOptions, is_finished

    scene = output.with_name(f"{output.name}_scene")
    if is_finished(scene, source):
        if not quiet:
            click.echo(f"{source}: photos without poses; {scene} has been made of them")
        return scene
    if overwrite is not None:
        RunFolder(output).check_free(overwrite)
    if not quiet:
        click.echo(
            f"{source}: photos without poses; makes a scene in {scene} first, as `clsplat sfm {source} -o {scene}` does"
        )
    _make_scene(source, scene, SfmOptions(), False, quiet)
    return scene


def _make_scene(photos: Path, output: Path, options: SfmOptions, overwrite: bool, quiet: bool) -> None:
    """Reconstruct a scene with a progress line, and say what came out."""
    from clsplat.cli.progress import Progress
    from clsplat.sfm.reconstruct import reconstruct
    from clsplat.training.progress import SilentProgress

    with nullcontext(SilentProgress()) if quiet else Progress() as progress:
        record = reconstruct(photos, output, options, progress, overwrite)
    if not quiet:
        click.echo(
            f"{output}: {record['registered']} of {record['photos']} photos, "
            f"{record['points']:,} points, reprojection error "
            f"{record['reprojection_error_pixels']:.2f} pixels, "
            f"{record['seconds']:.0f} s"
        )
        missing = list(record["not_registered"].items())
        for name, why in missing[:SHOWN]:
            click.echo(f"  {name}: {why}")
        if len(missing) > SHOWN:
            click.echo(f"  and {len(missing) - SHOWN} more, see {output / 'sfm.json'}")
        for note in record["notes"]:
            if note not in record["warnings"]:
                click.echo(f"  {note}")
    for warning in record["warnings"]:
        click.echo(f"warning: {output}: {warning}", err=True)
