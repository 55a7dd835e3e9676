"""A campaign: the same scene trained with several schedules and seeds, then compared.

A run is folder OUTPUT/SCHEDULE.SEED. The same command again goes on where the last one ended.
"""

import os
from pathlib import Path

import click

from clsplat.config.option import differences, options_of
from clsplat.errors import ClsplatError, InputError, Interrupted
from clsplat.options import TrainOptions, resolve, serves

NEW, STARTED, FINISHED = "from the start", "going on from its checkpoint", "finished before"


def combinations(file_values, flag_values, schedules, seeds):
    """The TrainOptions of every schedule with every seed; those of one seed follow each other, so
    that a campaign cut short has compared all schedules.

    file_values, flag_values: as for `resolve`, which each schedule completes in its own way; one
    that means something to another of the schedules only is left out. schedules: names with commas
    between them; seeds: how many, counted from the seed given. Raises InputError.
    """
    names = schedules.split(",")
    if len(set(names)) < len(names):
        raise InputError(f"--schedules {schedules}: names one twice; leave the second out")
    if seeds < 1:
        raise InputError(f"--seeds {seeds}: wants at least 1")
    given = {**file_values, **flag_values}
    if given.get("stop_at"):
        raise InputError("--stop-at: cannot go with --schedules, which finishes every run; "
                         "leave one of them out")
    serving = {option.name: [name for name in names if serves(option, name)]
               for option in options_of(TrainOptions)}
    return [resolve({}, {**{key: value for key, value in given.items()
                            if name in (serving[key] or names)},
                         "schedule": name, "seed": given.get("seed", 0) + number})
            for number in range(seeds) for name in names]


def run_campaign(train_one, wanted, output, scene):
    """Train what is not finished yet, then print and write the comparison of all.

    train_one: called as train_one(options, folder, resume), resume: whether to go on from the
    folder's checkpoint; if not, it may overwrite: the folder holds at most a start without one.
    wanted: TrainOptions as from `combinations`; scene: the path that they train on. A run that
    fails does not stop the others. Raises InputError: before any training if a folder holds another
    run, at the end if one failed.
    """
    states = [_state(Path(output) / f"{o.schedule}.{o.seed}", o, scene) for o in wanted]
    finished, failed = [], []
    for number, (options, (folder, state)) in enumerate(zip(wanted, states), 1):
        click.echo(f"[{number}/{len(wanted)}] {folder}: {state}")
        if state != FINISHED:
            try:
                train_one(options, folder, state == STARTED)
            except Interrupted as error:
                raise Interrupted(f"{error}; the same command as before goes on with the whole "
                                  "campaign") from None
            except ClsplatError as error:
                click.echo(f"failed: {error}", err=True)
                failed.append(folder)
                continue
        finished.append(folder)
    if finished:
        from clsplat.report.compare import write_comparison
        text, page = write_comparison(finished, output)
        click.echo(f"\n{text}\n\npage: {click.format_filename(page)}")
    if failed:
        raise InputError(f"{', '.join(map(str, failed))}: {len(failed)} of {len(wanted)} runs "
                         "failed, for the reasons above; the same command tries them again")


def _state(folder, options, scene):
    """(folder, NEW, STARTED or FINISHED); InputError if the folder holds another run."""
    from clsplat.io.run import OPTIONS, RunFolder
    if not (folder / OPTIONS).exists():
        with RunFolder(folder).locked():
            RunFolder.create(folder)
        return folder, NEW
    run = RunFolder.open(folder)
    record = run.read_options()
    cure = "choose another -o, or remove that folder"
    if not _is_of(run, record, scene):
        raise InputError(f"{folder}: holds a run of another scene, {record.get('scene')}; {cure}")
    for name, there, here in differences(record, options):
        raise InputError(f"{folder}: holds a run with {name} {there}, not {here}; {cure}")
    if run.is_finished:
        return folder, FINISHED
    return folder, STARTED if run.has_checkpoint else NEW


def _is_of(run, record, scene):
    """Whether a run was trained on this scene, which may have been moved since."""
    from clsplat.io.scenes import fingerprint, read_scene
    try:
        if os.path.samefile(run.scene_path(), scene):
            return True
    except (InputError, OSError):
        pass
    return fingerprint(read_scene(scene, record.get("images") or "")) == record.get("fingerprint")
