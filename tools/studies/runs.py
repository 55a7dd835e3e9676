"""The runs of the studies: `clsplat train` is started where one is missing, several at a time.

A run is the folder OUT/SCENE/NAME.SEED. A finished run with equal options is used again, whatever
its name, so that studies may share OUT; a run that was stopped by Ctrl-C is resumed.
"""

import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from clsplat.cli.flags import given_options
from clsplat.cli.train import train
from clsplat.config.option import differences
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.io.runs.run import OPTIONS, RunFolder
from clsplat.options import TrainOptions, from_toml, resolve
from clsplat.report.groups import Trained


class Scene:
    """A scene's path and the downscale of its full resolution, from PATH or PATH:DOWNSCALE.

    InputError where the path does not exist.
    """

    def __init__(self, text):
        match = re.fullmatch(r"(.+):(\d+(?:\.\d+)?)", text)
        self.path, number = match.groups() if match else (text, "1")
        self.downscale = float(number)
        if not Path(self.path).exists():
            raise InputError(f"{self.path}: no such scene; check the path")
        self.name = Path(self.path).resolve().name.removesuffix(".npz")
        if self.downscale != 1:
            self.name += f"-r{number}"


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """A run that a study needs.

    Attributes
    ----------
    group : the common name of runs that differ by seed.
    flags : of `clsplat train`.
    options : the result of these flags.
    """

    scene: Scene
    group: str
    folder: Path
    flags: tuple[str, ...]
    options: TrainOptions


def planned(arguments, scene, group, seed, flags):
    """The PlannedRun of a group and a seed; the last value of a repeated flag counts.

    Parameters
    ----------
    arguments : the result of `evidence.parsed`.
    """
    folder = arguments.out / scene.name / f"{re.sub(r'[^a-zA-Z0-9+.]+', '-', group)}.{seed}"
    flags = ("-n", str(arguments.steps), "-r", f"{scene.downscale:g}", "--seed", str(seed),
             "--checkpoint-every", "0", *arguments.flags, *flags)
    context = train.make_context("clsplat train", [scene.path, "-o", str(folder), *flags])
    config = context.params["config"]
    options = resolve(from_toml(config) if config else {}, given_options(context))
    return PlannedRun(scene, group, folder, flags, options)


def trained(runs, jobs, gpus):
    """Train the runs that are missing, in order.

    Returns
    -------
    Scene name -> group -> the finished runs, as `Trained`; and the folders that failed.

    Raises
    ------
    InputError : before any training, for a folder that holds another run.
    """
    folders = [run.folder for run in runs]
    for run in runs:
        if folders.count(run.folder) > 1:
            raise InputError(f"{run.folder}: would hold two runs; give scenes and columns names "
                             "that differ")
    places = {run: finished(run) for run in runs}
    missing = [run for run, place in places.items() if place is None]
    print(f"{len(runs)} runs, {len(runs) - len(missing)} of them finished before", flush=True)
    for number, (run, code) in enumerate(_train(missing, jobs, gpus), 1):
        places[run] = None if code else run.folder
        print(f"[{number}/{len(missing)}] {run.folder}: {'failed' if code else 'finished'}",
              flush=True)
    groups = {}
    for run, place in places.items():
        group = groups.setdefault(run.scene.name, {}).setdefault(run.group, [])
        if place:
            read = Run.open(place)
            group.append(Trained(str(place), read.record, read.metrics, True))
    return groups, [run.folder for run, place in places.items() if place is None]


def finished(run):
    """The folder of a finished run with the options of a PlannedRun, or None."""
    for file in [run.folder / OPTIONS, *sorted(run.folder.parent.glob(f"*/{OPTIONS}"))]:
        if file.is_file():
            folder = RunFolder.open(file.parent)
            difference = _difference(folder.read_options(), run)
            if not difference and folder.has_model:
                return file.parent
            if difference and file.parent == run.folder:
                raise InputError(f"{run.folder}: holds a run with {difference}; choose another "
                                 "OUT, or remove that folder")
    return None


def _difference(record, run):
    """The first difference between a run's record and a PlannedRun, for people; None if equal."""
    scene = str(Path(run.scene.path).resolve())
    if record.get("scene_absolute") != scene:
        return f"scene_absolute {record.get('scene_absolute')}, not {scene}"
    for name, old, new in differences(record, run.options):
        if name != "eval_at" or not set(new) <= set(old or ()):
            return f"{name} {old}, not {new}"
    return None


def _train(runs, jobs, gpus):
    """Train runs, and yield each with its exit code when it ends."""
    slots = SimpleQueue()
    for slot in range(jobs):
        slots.put(slot)

    def one(run):
        slot = slots.get()
        environment = dict(os.environ)
        if gpus:
            environment["CUDA_VISIBLE_DEVICES"] = str(slot % gpus)
        if jobs > 1:  # PoCL's cache of built kernels is not safe across processes
            cache = Path.home() / ".cache" / "clsplat-tools" / str(slot)
            cache.mkdir(parents=True, exist_ok=True)
            environment["POCL_CACHE_DIR"] = str(cache)
        how = "--resume" if RunFolder(run.folder).has_checkpoint else "--overwrite"
        try:
            return subprocess.run([sys.executable, "-m", "clsplat", "train", run.scene.path,
                                   *run.flags, "-o", str(run.folder), how, "-q"],
                                  check=False, env=environment).returncode
        finally:
            slots.put(slot)

    with ThreadPoolExecutor(jobs) as pool:
        futures = {pool.submit(one, run): run for run in runs}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:  # Ctrl-C: the running ones save their state, no others begin
            pool.shutdown(wait=False, cancel_futures=True)
            raise
