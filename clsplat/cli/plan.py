"""`clsplat plan`: what a training would leave out, and the memory and time it would take."""

from pathlib import Path

import click

from clsplat.cli.flags import given_options, training_flags
from clsplat.cli.sections import SectionedCommand
from clsplat.errors import InputError

MIB = 2**20
MOST_PHOTOS = 10**9
WIDTH = 12  # of the column of names


@click.command(cls=SectionedCommand)
@click.argument("scene", type=click.Path(path_type=Path))
@training_flags
@click.option("--config", type=click.Path(path_type=Path),
              help="TOML file of options; flags win over it.")
@click.option("--photos", default="", help="Also say what cities of so many photos like these "
              "would take, in blocks: such as 1000,10000,100000.")
@click.option("--margin", default=0.3, show_default=True,
              help="Of these blocks; see `clsplat city`.")
@click.pass_context
def plan(ctx, scene, config, photos, margin, **_):
    """Say what `clsplat train` would do with SCENE, given the same options.

    One line a part that may be left out: its value, the reason, and the number behind it; a flag
    overrides a line. Then the memory that the training takes on the device at most, and its time,
    from a few real steps.
    """
    from clsplat.cli.progress import Progress
    from clsplat.device import choose_device
    from clsplat.estimate.forecast import Planned
    from clsplat.estimate.step_time import load
    from clsplat.io.scenes import read_scene
    from clsplat.options import from_toml, resolve
    from clsplat.partition.options import PartitionOptions
    from clsplat.training.photos import size_note
    options = resolve(from_toml(config) if config else {}, given_options(ctx))
    photos, margin = _numbers(photos), PartitionOptions(margin=margin).margin
    busy, progress = load(), Progress()
    with progress:
        progress.phase("reading the scene")
        data = read_scene(scene, options.images)
        device = choose_device(options.device, form=options.form)
        planned = Planned(data, options, device, progress)
    prepared = planned.prepared
    click.echo(f"{data.name}: {len(prepared.train_views)} photos to train on, "
               f"{len(prepared.test_views)} held out, {len(data.points):,} points; {device.name}")
    if note := size_note(data.views, options):
        click.echo(f"  {note}")
    for name, reason in prepared.decisions.reasons.items():
        _line(name, reason)
    with progress:
        forecast = planned.forecast()
    _line("photos", forecast.streaming.reason)
    _line("memory", _memory(forecast, device))
    _line("time", _time(forecast, busy))
    if photos:
        from clsplat.city.forecast import scale_table
        click.echo("\n" + scale_table(planned, forecast, device, margin, photos).text())


def _numbers(text):
    if not text:
        return []
    try:
        numbers = [int(part) for part in text.split(",")]
        if min(numbers) < 1 or max(numbers) > MOST_PHOTOS:
            raise ValueError
    except ValueError:
        raise InputError(f"--photos {text[:80]}: wants whole numbers from 1 to {MOST_PHOTOS:,}, "
                         "such as 1000,10000,100000") from None
    return numbers


def _line(name, text):
    click.echo(f"  {name.replace('_', ' '):<{WIDTH}}  {text}")


def _memory(forecast, device):
    memory, there = forecast.memory, device.handle.global_mem_size
    text = (f"{memory.total / MIB:,.0f} MiB at most, of {there / MIB:,.0f}: "
            f"{forecast.gaussians:,} gaussians {memory.model / MIB:,.0f}, photos "
            f"{memory.photos / MIB:,.0f}, the rest for the step")
    return text if memory.total < there else f"{text}; does not fit: use --max-gaussians or -r"


def _time(forecast, load):
    (_, _, begin), (level, gaussians, end) = forecast.ends
    text = (f"about {duration(forecast.seconds)} for {forecast.steps:,} steps: a step takes "
            f"{1e3 * begin:.1f} ms at first, and {1e3 * end:.1f} ms at the end at level {level:g} "
            f"with {gaussians:,} gaussians")
    if load:
        text += (f"; this machine is busy (load {load[0]:.1f} on {load[1]} cores), so this is an "
                 "upper estimate")
    return text


def duration(seconds):
    """Such as 45 s, 12 min 05 s, 6 h 37 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    minutes = round(whole / 60)
    return f"{minutes // 60:,} h {minutes % 60:02d} min"
