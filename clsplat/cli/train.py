"""`clsplat train`: a scene in, a run folder out."""

import dataclasses
import logging
from contextlib import nullcontext
from pathlib import Path

import click

from clsplat.cli.flags import given_options, training_flags
from clsplat.cli.sections import SectionedCommand, SectionedOption
from clsplat.config.option import differences, flag_name, options_of
from clsplat.errors import InputError
from clsplat.options import RunOptions, TrainOptions, checked, from_toml, resolve

LEVELS = ("debug", "info", "warning", "error")
FOLDER = {"cls": SectionedOption, "section": "Run folder"}


@click.command(cls=SectionedCommand)
@click.argument("scene", type=click.Path(path_type=Path), required=False)
@training_flags
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), **FOLDER,
              help="Folder of the run: options, metrics, checkpoints, point_cloud.ply.")
@click.option("--config", type=click.Path(path_type=Path), **FOLDER,
              help="TOML file of options; flags win over it.")
@click.option("--resume", is_flag=True, **FOLDER,
              help="Go on from the run's last checkpoint, with its options; SCENE is needed only "
              "where the scene was moved.")
@click.option("--overwrite", is_flag=True, **FOLDER, help="Replace a run that is there.")
@click.option("--schedules", **FOLDER, help="Several schedules, commas between them: each with "
              "each seed becomes OUTPUT/SCHEDULE.SEED, then they are compared. The same command "
              "goes on where the last one ended.")
@click.option("--seeds", type=int, default=1, show_default=True, **FOLDER,
              help="How many seeds, with --schedules.")
@click.option("-q", "--quiet", is_flag=True, help="No progress line.")
@click.option("--log-level", type=click.Choice(LEVELS), default="warning", show_default=True,
              help="Which log messages to show.")
@click.pass_context
def train(ctx, scene, output, config, resume, overwrite, schedules, seeds, quiet, log_level, **_):
    """Train gaussians on SCENE, a COLMAP folder with sparse/ and images/.

    Defaults are those of --schedule sig; other schedules, --preset and --size L bring some of their
    own, and what was used stands in the run's options.json.
    """
    logging.basicConfig(level=log_level.upper(), format="%(levelname)s %(name)s: %(message)s")
    if resume and (overwrite or config):
        raise InputError(f"{'--overwrite' if overwrite else '--config'}: cannot go with --resume, "
                         "which continues the run as it was; leave one of them out")
    flags = given_options(ctx)
    values = from_toml(config) if config else {}
    if scene is None and not resume:
        raise click.MissingParameter(ctx=ctx, param=ctx.command.params[0])
    if schedules:
        if resume or overwrite or "schedule" in flags:
            raise InputError("--schedules: goes on by itself and names the schedules; leave out "
                             "--resume, --overwrite and --schedule")
        _campaign(scene, output, values, flags, schedules, seeds, quiet)
        return
    if seeds != 1:
        raise InputError("--seeds: wants --schedules; for one run, use --seed")
    _train(scene, output, None if resume else resolve(values, flags), flags, overwrite, quiet)
    if not quiet:
        click.echo(f"{output}: next, `clsplat eval {output}`")


def _train(scene, output, options, flags, overwrite, quiet):
    """One run; options: TrainOptions, or None to go on from its checkpoint with `flags`."""
    from clsplat.device import choose_device
    from clsplat.io.run import RunFolder
    from clsplat.io.scenes import read_scene
    from clsplat.training import loop
    resumes = options is None
    run = RunFolder.open(output) if resumes else RunFolder(output)
    if resumes:
        options = resumed_options(run.read_options(), flags)
    data = read_scene(run.scene_path(scene) if resumes else scene, options.images)
    device = choose_device(options.device, form=options.form)
    with run.locked(), nullcontext() if quiet else _progress(options) as progress:
        if resumes:
            loop.resume(data, options, device, run, progress=progress)
        else:
            run = RunFolder.create(output, overwrite=overwrite)
            loop.train(data, options, device, run, progress=progress)


def _campaign(scene, output, values, flags, schedules, seeds, quiet):
    """Every schedule with every seed, then their comparison."""
    from clsplat.cli.campaign import combinations, run_campaign

    def train_one(options, folder, resume):
        _train(scene, folder, None if resume else options, {}, True, quiet)

    run_campaign(train_one, combinations(values, flags, schedules, seeds), output, scene)


def resumed_options(record, flags):
    """TrainOptions of a run's record (dict) with the flags that a resumed one may change.

    A stop of the first part does not stop the second. Raises InputError for other flags.
    """
    known = {option.name for option in options_of(TrainOptions)}
    options = resolve({name: checked("options.json", name, value) for name, value in record.items()
                       if name in known}, {})
    wanted = dataclasses.replace(options, **{"stop_at": RunOptions.stop_at, **flags})
    for name, there, _ in differences(dataclasses.asdict(options), wanted):
        raise InputError(f"{flag_name(name)}: cannot change at --resume, the run has {there!r}; "
                         "leave it out, or start a new run")
    return wanted


def _progress(options):
    from clsplat.cli.progress import Progress
    return Progress(options.stop_at)
