"""A campaign: the same scene trained with several schedules and seeds, then compared.

A run is the folder OUTPUT/SCHEDULE.SEED. The same command again continues an interrupted campaign.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.config.option import differences, options_of
from clsplat.errors import ClsplatError, InputError, Interrupted
from clsplat.options import TrainOptions, options_with, resolve, serves

if TYPE_CHECKING:
    from clsplat.io.runs.run import RunFolder

NEW, STARTED, FINISHED = "from the start", "from its checkpoint", "finished before"


@dataclass(frozen=True)
class CampaignRun:
    """A run of a campaign, in its folder."""

    folder: Path
    options: TrainOptions

    def state(self, scene: Path) -> str:
        """NEW, STARTED or FINISHED; InputError if the folder holds another run."""
        from clsplat.io.runs.run import OPTIONS, RunFolder
        if not (self.folder / OPTIONS).exists():
            with RunFolder(self.folder).locked():
                RunFolder.create(self.folder)
            return NEW
        run = RunFolder.open(self.folder)
        record = run.read_options()
        cure = "choose another -o, or remove that folder"
        if not _is_of(run, record, scene):
            raise InputError(f"{self.folder}: holds a run of another scene, {record.get('scene')}; "
                             f"{cure}")
        for name, old, new in differences(record, self.options):
            raise InputError(f"{self.folder}: holds a run with {name} {old}, not {new}; {cure}")
        if run.is_finished:
            return FINISHED
        return STARTED if run.has_checkpoint else NEW


def combinations(file_values: dict[str, Any], flag_values: dict[str, Any], schedules: str,
                 seeds: int) -> list[TrainOptions]:
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
    if seeds < 1:
        raise InputError(f"--seeds {seeds}: expects at least 1")
    given = {**file_values, **flag_values}
    if given.get("stop_at"):
        raise InputError("--stop-at: cannot be used with --schedules, which finishes every run; "
                         "leave one of them out")
    serving = {option.name: [name for name in names if serves(option, name)]
               for option in options_of(options_with(*names))}
    return [resolve({}, {**{key: value for key, value in given.items()
                            if name in (serving[key] or names)},
                         "schedule": name, "seed": given.get("seed", 0) + number})
            for number in range(seeds) for name in names]


def run_campaign(train_one: Callable[[CampaignRun, bool], object],
                 runs: list[TrainOptions], output: Path, scene: Path) -> None:
    """Train the runs that are not finished, then print and write the comparison of all.

    A run that fails does not stop the others.

    Parameters
    ----------
    train_one : called with a run, and whether to resume it from its checkpoint; if not, it may
        overwrite the folder, which has no checkpoint.
    runs : the result of `combinations`.
    scene : the path of the scene.

    Raises
    ------
    InputError : before any training if a folder holds another run; at the end if a run failed.
    """
    planned = [CampaignRun(Path(output) / f"{each.schedule}.{each.seed}", each) for each in runs]
    states = [each.state(scene) for each in planned]
    finished, failed = [], []
    for number, (run, state) in enumerate(zip(planned, states), 1):
        click.echo(f"[{number}/{len(runs)}] {run.folder}: {state}")
        if state != FINISHED:
            try:
                train_one(run, state == STARTED)
            except Interrupted as error:
                raise Interrupted(f"{error}; the same command as before continues the whole "
                                  "campaign") from None
            except ClsplatError as error:
                click.echo(f"failed: {error}", err=True)
                failed.append(run.folder)
                continue
        finished.append(run.folder)
    if finished:
        from clsplat.report.compare import write_comparison
        text, page = write_comparison(finished, output)
        click.echo(f"\n{text}\n\npage: {click.format_filename(page)}")
    if failed:
        raise InputError(f"{', '.join(map(str, failed))}: {len(failed)} of {len(runs)} runs "
                         "failed for the reasons above; the same command tries them again")


def _is_of(run: RunFolder, record: dict[str, Any], scene: Path) -> bool:
    """Whether a run was trained on this scene, which may have been moved since."""
    from clsplat.io.scenes.read import fingerprint, read_scene
    try:
        if os.path.samefile(run.scene_path(), scene):
            return True
    except (InputError, OSError):
        pass
    images = record.get("images") or ""
    return bool(fingerprint(read_scene(scene, images)) == record.get("fingerprint"))
