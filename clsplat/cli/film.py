"""`clsplat film`: a flight through a run."""

import re
from fractions import Fraction
from pathlib import Path

import click

from clsplat.cli import flags
from clsplat.errors import InputError

LARGEST_SIDE = 8192  # pixels: the most that H.264 has a level for
AUTO, PHOTOS, TURNTABLE = "auto", "photos", "turntable"


def _size(text: str) -> tuple[int, int]:
    """A width and a height in pixels."""
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.lower())
    width, height = map(int, match.groups()) if match else (0, 0)
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        raise ValueError(f"not a size; give width and height in pixels, at most {LARGEST_SIDE}, such as 1280x720")
    return width, height


@click.command()
@click.argument("run", type=flags.PATH)
@click.option(
    "-o", "--output", required=True, type=flags.PATH, help="A file .mp4, .mov or .mkv, or a folder for frames as PNG."
)
@click.option(
    "--path",
    "route",
    default=AUTO,
    show_default=True,
    metavar="PATH",
    help="auto: obliquely over a site whose photos look down, else as photos; photos: "
    "along the photos; turntable: around the scene; or a JSON file with a camera path.",
)
@click.option(
    "--seconds", type=flags.FiniteRange(0.1, 36_000), default=20.0, show_default=True, help="Length of the film."
)
@click.option("--fps", type=flags.FiniteRange(1, 240), default=30.0, show_default=True, help="Frames a second.")
@click.option(
    "--size", type=flags.Parsed("WIDTHxHEIGHT", _size), default="1280x720", show_default=True, help="Pixels of a frame."
)
@click.option(
    "--fov",
    type=flags.FiniteRange(1, 170),
    help="Horizontal angle of view, degrees. Default: that of the photos or of the camera path.",
)
@flags.everything_flag
@click.option("--overwrite", is_flag=True, help="Replace an existing film.")
@flags.host_memory_flag
@flags.moved_scene_flag
@flags.device_flag
def film(
    run: Path,
    output: Path,
    route: str,
    seconds: float,
    fps: float,
    size: tuple[int, int],
    fov: float | None,
    everything: bool,
    overwrite: bool,
    host_memory: int | None,
    scene: Path | None,
    device: str,
) -> None:
    """Draw a flight through RUN as a film."""
    from dataclasses import replace
    from functools import partial

    import numpy as np

    from clsplat.apps import camera_path as paths
    from clsplat.apps import film as films
    from clsplat.cli.progress import Progress
    from clsplat.device import choose_device
    from clsplat.evaluation.run import Run

    as_film = output.suffix.lower() in films.SUFFIXES
    if not as_film and output.suffix:
        raise InputError(
            f"{output}: unknown suffix '{output.suffix}'; known: {', '.join(films.SUFFIXES)}, or a folder for PNG files"
        )
    if as_film and (size[0] % 2 or size[1] % 2):
        raise InputError(f"--size {size[0]}x{size[1]}: a film needs even numbers; give such, or a folder for PNG files")
    if as_film or films.frames_in(output):
        flags.check_free(output, overwrite)
    if as_film:
        films.check_codec()
    opened = Run.open(run)
    most = flags.host_bytes(host_memory, run)
    data = opened.scene(scene).with_up(opened.up)
    count = max(1, round(seconds * fps))
    times = np.linspace(0, 1, count)
    if route in (AUTO, PHOTOS):
        keys = (paths.auto if route == AUTO else paths.flight)(data, seconds)
    elif route == TURNTABLE:  # the last frame is not the first once more
        keys, times = paths.turntable(data), np.arange(count) / count
    else:
        keys = paths.read_camera_path(Path(route))
    if fov is not None:
        keys = replace(keys, degrees=fov)
    cameras = paths.interpolated(keys, times, size, paths.film_degrees(data))
    with Progress() as progress:
        progress.phase("opening the device")
        pictures = films.frames(opened, data, cameras, choose_device(device), most, everything)
        shown = partial(progress.count, "frame", total=count)
        if as_film:
            films.write_film(output, pictures, size, Fraction(fps).limit_denominator(1001), shown)
        else:
            films.write_frames(output, pictures, shown)
    frame = "frame" if count == 1 else "frames"
    click.echo(f"{output}: {count} {frame} of {size[0]} x {size[1]} pixels, {count / fps:.1f} s")
