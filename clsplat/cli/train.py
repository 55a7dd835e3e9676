"""`clsplat train`: train a scene into a run folder."""

from __future__ import annotations

import dataclasses
import logging
import shlex
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.cli import STARTED, flags
from clsplat.cli.sfm import trained_scene
from clsplat.config.option import differences, flag_name
from clsplat.errors import InputError
from clsplat.options import RunOptions, TrainOptions, recorded, resolve

if TYPE_CHECKING:
    from clsplat.device import Device

LEAST_SHOWN = 0.05  # seconds
LOG_LEVELS = ("debug", "info", "warning", "error")
FOLDER: dict[str, Any] = {"cls": flags.SectionedOption, "section": "Run folder"}


@click.command(cls=flags.TrainingCommand, short_help="Train gaussians on photos, or on a scene.")
@click.argument("scene", type=flags.PATH, required=False)
@flags.training_flags
@click.option(
    "-o",
    "--output",
    required=True,
    type=flags.PATH,
    **FOLDER,
    help="Folder of the run: options, metrics, checkpoints, point_cloud.ply.",
)
@click.option(
    "--up",
    nargs=3,
    type=flags.FiniteRange(),
    **FOLDER,
    help="X Y Z: the direction in "
    "the scene that points up; default: that of the scene's files, or estimated from the "
    "cameras and points.",
)
@click.option(
    "--resume",
    is_flag=True,
    **FOLDER,
    help="Continue from the run's last checkpoint, with its options; SCENE is needed only if the scene was moved.",
)
@click.option("--overwrite", is_flag=True, **FOLDER, help="Replace an existing run.")
@click.option(
    "--schedules",
    **FOLDER,
    help="Several schedules, separated by commas: train each "
    "with each seed in OUTPUT/SCHEDULE.SEED, then compare them. The same command "
    "continues where the last one ended.",
)
@click.option(
    "--seeds",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    **FOLDER,
    help="Number of seeds, with --schedules.",
)
@click.option(
    "--view",
    is_flag=True,
    **FOLDER,
    help="Show the training on a page for the browser "
    "of this machine, at an address that is printed; the result is the same.",
)
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
@click.option(
    "--log-level",
    type=click.Choice(LOG_LEVELS),
    default="warning",
    show_default=True,
    help="The least severe log messages to show.",
)
@click.pass_context
def train(
    ctx: click.Context,
    /,
    scene: Path | None,
    output: Path,
    up: tuple[float, float, float] | None,
    resume: bool,
    overwrite: bool,
    schedules: str | None,
    seeds: int,
    view: bool,
    quiet: bool,
    log_level: str,
    **_options: object,
) -> None:
    """Train gaussians on SCENE: a folder of photos, a video, or a scene such as a COLMAP folder.

    From photos alone, or a video, a scene is made first, as `clsplat sfm` does, in OUTPUT_scene. A
    COLMAP folder has sparse/ and images/. Defaults are those of --schedule sig; other
    schedules, --preset and --size L change some of them. The run's options.json has all values that
    were used.
    """
    logging.basicConfig(level=log_level.upper(), format="%(levelname)s %(name)s: %(message)s")
    for name in ("overwrite", "config", "up"):
        if resume and ctx.params[name]:
            raise InputError(
                f"{flag_name(name)}: cannot be used with --resume, which continues "
                "the run as it was; leave one of them out"
            )
    given = flags.given_options(ctx)
    values = flags.config_options(ctx)
    if scene is None and not resume:
        raise click.MissingParameter(ctx=ctx, param=ctx.command.params[0])
    options = None if resume or schedules else resolve(values, given)
    opened = _opened(options) if options else None
    began, mapped = time.perf_counter(), 0.0
    if scene is not None:
        source = scene
        scene = trained_scene(scene, output, quiet, None if options is None else overwrite)
        if scene != source:
            mapped = time.perf_counter() - began
    if schedules:
        if resume or overwrite or "schedule" in given:
            raise InputError(
                "--schedules: resumes runs by itself and names the schedules; leave "
                "out --resume, --overwrite and --schedule"
            )
        if view:
            raise InputError(
                "--view: shows a single training; leave out --schedules, or look at each run with `clsplat view`"
            )
        from clsplat.cli.campaign import combinations, run_campaign

        run_campaign(
            lambda folder, options: _train(scene, folder, options, {}, True, quiet, up),
            combinations(values, given, schedules, seeds),
            output,
        )
        return
    if seeds != 1:
        raise InputError("--seeds: needs --schedules; for one run, use --seed")
    spent = _train(scene, output, options, given, overwrite, quiet, up, view, opened)
    if not quiet:
        click.echo("\n".join([*ending(output), time_line(spent, mapped)]))


def time_line(spent: dict[str, float], mapped: float = 0.0) -> str:
    """What the seconds of a command were spent for; in those before its first phase, the scene was
    made of photos for so long."""
    from clsplat.training.progress import BEGIN

    spent = {
        BEGIN: spent[BEGIN] - mapped,
        "poses": mapped,
        **{purpose: seconds for purpose, seconds in spent.items() if purpose != BEGIN},
    }
    parts = ", ".join(f"{purpose} {seconds:.1f}" for purpose, seconds in spent.items() if seconds >= LEAST_SHOWN)
    return f"time:    {sum(spent.values()):.1f} s: {parts}"


def ending(output: Path) -> list[str]:
    """The last lines of a training: warnings of its place, and what can be done with the result."""
    from clsplat.io.georeference.files import read_georeference
    from clsplat.io.runs.run import REPORT

    known = read_georeference(output)
    warnings = [f"warning: {text}" for text in known.warnings] if known else []
    report = [f"report:  {output / REPORT}"] if (output / REPORT).is_file() else []
    page = output.parent / f"{output.resolve().name}.html"
    folder, page_file = (shlex.quote(str(path)) for path in (output, page))
    return [*warnings, *report, f"look:    clsplat view {folder}", f"send:    clsplat export {folder} -o {page_file}"]


def _train(
    scene: Path | None,
    output: Path,
    options: TrainOptions | None,
    given: dict[str, Any],
    overwrite: bool,
    quiet: bool,
    up: tuple[float, float, float] | None = None,
    view: bool = False,
    opened: Future[Device] | None = None,
) -> dict[str, float]:
    """Train one run; without options, continue from its checkpoint with `given`. Returns what the
    seconds were spent for, see `SilentProgress.spent`. `opened` is the device of the options."""
    from clsplat.cli.progress import Progress
    from clsplat.cli.view import announce
    from clsplat.io.runs.run import RunFolder
    from clsplat.training.progress import SilentProgress

    resumes = options is None
    run = RunFolder.open(output) if resumes else RunFolder(output)
    if options is None:
        options, scene = resumed_options(run.read_options(), given), run.scene_path(scene)
    assert scene is not None  # only a run that resumes is given none
    opened = opened or _opened(options)
    from clsplat.io.scenes.read import read_scene
    from clsplat.training import run as trainings

    data = read_scene(scene, options.images)
    if up is not None:
        if data.georeference is not None:
            raise InputError(f"--up: {scene} is georeferenced, so its z axis points up; leave it out")
        data = data.with_up(up)
    device = opened.result()
    with ExitStack() as stack:
        stack.enter_context(run.locked())
        progress = SilentProgress(STARTED) if quiet else stack.enter_context(Progress(options.stop_at, began=STARTED))
        watcher = None
        if view:
            from clsplat.apps.live import TrainingView

            watcher = progress = stack.enter_context(TrainingView(data, progress))
            announce(watcher.address)
        if resumes:
            trainings.resumed(data, options, device, run, progress=progress, watcher=watcher).take()
        else:
            run = RunFolder.create(output, overwrite=overwrite)
            trainings.train(data, options, device, run, progress=progress, watcher=watcher)
        return progress.spent()


def _opened(options: RunOptions) -> Future[Device]:
    """The device, which a thread opens while modules are imported and files are read; another
    imports what every start asks for neighbours."""
    from clsplat.device import choose_device

    pool = ThreadPoolExecutor(2)
    click.get_current_context().call_on_close(pool.shutdown)
    opened = pool.submit(choose_device, options.device, form=options.form)
    pool.submit(import_module, "scipy.spatial")
    return opened


def resumed_options(record: dict[str, Any], given: dict[str, Any]) -> TrainOptions:
    """The options of a resumed run: those of its record, with the `given` ones.

    --stop-at of the first part does not stop the second. InputError for flags that may not change.
    """
    options = recorded(record)
    changed = dataclasses.replace(options, **{"stop_at": RunOptions.stop_at, **given})
    for name, old, _ in differences(dataclasses.asdict(options), changed):
        raise InputError(
            f"{flag_name(name)}: cannot change at --resume, the run has {old!r}; leave it out, or start a new run"
        )
    return changed
