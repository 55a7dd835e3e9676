"""A campaign: the same scene trained with several schedules and seeds, then compared.

A run is the folder OUTPUT/SCHEDULE.SEED. The same command again continues an interrupted campaign.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from clsplat.config.option import differences, options_of
from clsplat.errors import ClsplatError, InputError, Interrupted
from clsplat.options import TrainOptions, options_with, resolve, serves


def combinations(
    file_values: dict[str, Any], flag_values: dict[str, Any], schedules: str, seeds: int
) -> list[TrainOptions]:
    """The options of every schedule with every seed.

    All schedules with one seed come before those with the next, so that an interrupted campaign can
    compare them.

    Parameters
    ----------
    file_values, flag_values : as for `resolve`; a schedule ignores options of the other schedules.
    schedules : names with commas between them.
    seeds : the number of seeds, counted from the option's seed.
    """
    names = schedules.split(",")
    if len(set(names)) < len(names):
        raise InputError(f"--schedules {schedules}: names one twice; leave the second out")
    given = {**file_values, **flag_values}
    if given.get("stop_at"):
        raise InputError("--stop-at: cannot be used with --schedules, which finishes every run; leave one of them out")
    serving = {
        option.name: [name for name in names if serves(option, name)] for option in options_of(options_with(*names))
    }
    return [
        resolve(
            {},
            {
                **{key: value for key, value in given.items() if name in (serving[key] or names)},
                "schedule": name,
                "seed": given.get("seed", 0) + number,
            },
        )
        for number in range(seeds)
        for name in names
    ]


def run_campaign(
    train_one: Callable[[Path, TrainOptions | None], object], runs: list[TrainOptions], output: Path
) -> None:
    """Train the runs that are not finished, then print and write the comparison of all.

    `train_one` trains a run into a folder; without options it resumes it. InputError at the end for
    runs that failed, or whose folder holds a run with other options; others are trained.
    """
    from clsplat.io.runs.run import RunFolder

    finished, failed = [], []
    for number, options in enumerate(runs, 1):
        folder = output / f"{options.schedule}.{options.seed}"
        run = RunFolder(folder)
        click.echo(f"[{number}/{len(runs)}] {folder}")
        try:
            for name, old, new in differences(run.read_options(), options) if run.is_begun else ():
                raise InputError(
                    f"{folder}: holds a run with {name} {old}, not {new}; choose another -o, or remove that folder"
                )
            if not (run.is_begun and run.is_finished):
                train_one(folder, None if run.has_checkpoint else options)
            finished.append(folder)
        except Interrupted as error:
            raise Interrupted(f"{error}; the same command as before continues the whole campaign") from None
        except ClsplatError as error:
            click.echo(f"failed: {error}", err=True)
            failed.append(folder)
    if finished:
        from clsplat.report.compare import write_comparison

        text, page = write_comparison(finished, output)
        click.echo(f"\n{text}\n\npage: {click.format_filename(page)}")
    if failed:
        raise InputError(
            f"{', '.join(map(str, failed))}: {len(failed)} of {len(runs)} runs "
            "failed for the reasons above; the same command tries them again"
        )
