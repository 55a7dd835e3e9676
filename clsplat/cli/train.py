"""`clsplat train`: train a scene into a run folder."""

from __future__ import annotations

import dataclasses
import logging
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from clsplat.cli.flags import given_options, training_flags
from clsplat.cli.sections import SectionedCommand, SectionedOption
from clsplat.config.option import differences, flag_name
from clsplat.errors import InputError
from clsplat.options import RunOptions, TrainOptions, from_toml, recorded, resolve

LOG_LEVELS = ("debug", "info", "warning", "error")
FOLDER: dict[str, Any] = {"cls": SectionedOption, "section": "Run folder"}


@click.command(cls=SectionedCommand)
@click.argument("scene", type=click.Path(path_type=Path), required=False)
@training_flags
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), **FOLDER,
              help="Folder of the run: options, metrics, checkpoints, point_cloud.ply.")
@click.option("--config", type=click.Path(path_type=Path), **FOLDER,
              help="TOML file of options; flags override it.")
@click.option("--resume", is_flag=True, **FOLDER,
              help="Continue from the run's last checkpoint, with its options; SCENE is needed "
              "only if the scene was moved.")
@click.option("--overwrite", is_flag=True, **FOLDER, help="Replace an existing run.")
@click.option("--schedules", **FOLDER, help="Several schedules, separated by commas: train each "
              "with each seed in OUTPUT/SCHEDULE.SEED, then compare them. The same command "
              "continues where the last one ended.")
@click.option("--seeds", type=int, default=1, show_default=True, **FOLDER,
              help="Number of seeds, with --schedules.")
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
@click.option("--log-level", type=click.Choice(LOG_LEVELS), default="warning", show_default=True,
              help="The least severe log messages to show.")
@click.pass_context
def train(ctx: click.Context, /, scene: Path | None, output: Path, config: Path | None,
          resume: bool, overwrite: bool, schedules: str | None, seeds: int, quiet: bool,
          log_level: str, **_options: object) -> None:
    """Train gaussians on SCENE, such as a COLMAP folder.

    A COLMAP folder has sparse/ and images/. Defaults are those of --schedule sig; other schedules,
    --preset and --size L change some of them. The run's options.json has all values that were used.
    """
    logging.basicConfig(level=log_level.upper(), format="%(levelname)s %(name)s: %(message)s")
    if resume and (overwrite or config):
        raise InputError(f"{'--overwrite' if overwrite else '--config'}: cannot be used with "
                         "--resume, which continues the run as it was; leave one of them out")
    flags = given_options(ctx)
    values = from_toml(config) if config else {}
    if scene is None and not resume:
        raise click.MissingParameter(ctx=ctx, param=ctx.command.params[0])
    if schedules:
        if resume or overwrite or "schedule" in flags:
            raise InputError("--schedules: resumes runs by itself and names the schedules; leave "
                             "out --resume, --overwrite and --schedule")
        assert scene is not None  # else the error above
        _campaign(scene, output, values, flags, schedules, seeds, quiet)
        return
    if seeds != 1:
        raise InputError("--seeds: needs --schedules; for one run, use --seed")
    _train(scene, output, None if resume else resolve(values, flags), flags, overwrite, quiet)
    if not quiet:
        click.echo(f"{output}: next, `clsplat eval {output}`")


def _train(scene: Path | None, output: Path, options: TrainOptions | None, flags: dict[str, Any],
           overwrite: bool, quiet: bool) -> None:
    """Train one run; without options, continue from its checkpoint with `flags`."""
    from clsplat.cli.progress import Progress
    from clsplat.device import choose_device
    from clsplat.io.run import RunFolder
    from clsplat.io.scenes import read_scene
    from clsplat.training import loop
    resumes = options is None
    run = RunFolder.open(output) if resumes else RunFolder(output)
    if options is None:
        options, scene = resumed_options(run.read_options(), flags), run.scene_path(scene)
    data = read_scene(scene, options.images)
    device = choose_device(options.device, form=options.form)
    with run.locked(), nullcontext() if quiet else Progress(options.stop_at) as progress:
        if resumes:
            loop.resume(data, options, device, run, progress=progress)
        else:
            run = RunFolder.create(output, overwrite=overwrite)
            loop.train(data, options, device, run, progress=progress)


def _campaign(scene: Path, output: Path, values: dict[str, Any], flags: dict[str, Any],
              schedules: str, seeds: int, quiet: bool) -> None:
    """Train every schedule with every seed, then compare them."""
    from clsplat.cli.campaign import combinations, run_campaign

    def train_one(options: TrainOptions, folder: Path, resume: bool) -> None:
        _train(scene, folder, None if resume else options, {}, True, quiet)

    run_campaign(train_one, combinations(values, flags, schedules, seeds), output, scene)


def resumed_options(record: dict[str, Any], flags: dict[str, Any]) -> TrainOptions:
    """The options of a resumed run, from its record and the flags that may change them.

    --stop-at of the first part does not stop the second. InputError for flags that may not change.
    """
    options = recorded(record)
    changed = dataclasses.replace(options, **{"stop_at": RunOptions.stop_at, **flags})
    for name, old, _ in differences(dataclasses.asdict(options), changed):
        raise InputError(f"{flag_name(name)}: cannot change at --resume, the run has {old!r}; "
                         "leave it out, or start a new run")
    return changed
