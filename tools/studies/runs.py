"""The runs that evidence rests on: `clsplat train` started where one is missing, several at a time.

A run is folder OUT/SCENE/NAME.SEED. One that finished with equal options serves again, under
whatever name, so that tools may share OUT; one that Ctrl-C stopped goes on.
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
from clsplat.io.run import OPTIONS, RunFolder
from clsplat.options import from_toml, resolve
from clsplat.report.groups import Trained


class Scene:
    """A scene's path and the downscale of its full resolution, from PATH or PATH:DOWNSCALE.

    InputError where there is nothing."""

    def __init__(self, text):
        found = re.fullmatch(r"(.+):(\d+(?:\.\d+)?)", text)
        self.path, number = found.groups() if found else (text, "1")
        self.downscale = float(number)
        if not Path(self.path).exists():
            raise InputError(f"{self.path}: no such scene; check the path")
        self.name = Path(self.path).resolve().name.removesuffix(".npz")
        if self.downscale != 1:
            self.name += f"-r{number}"


@dataclass(frozen=True, eq=False)
class Wanted:
    """scene: Scene; group: what runs that differ by seed have in common; flags: of `clsplat
    train`; options: the TrainOptions they stand for."""

    scene: Scene
    group: str
    folder: Path
    flags: tuple
    options: object


def wanted(given, scene, group, seed, flags):
    """One Wanted; given: namespace of `evidence.parsed`. A flag given twice has its last value."""
    folder = given.out / scene.name / f"{re.sub(r'[^a-zA-Z0-9+.]+', '-', group)}.{seed}"
    flags = ("-n", str(given.steps), "-r", f"{scene.downscale:g}", "--seed", str(seed),
             "--checkpoint-every", "0", *given.flags, *flags)
    context = train.make_context("clsplat train", [scene.path, "-o", str(folder), *flags])
    config = context.params["config"]
    options = resolve(from_toml(config) if config else {}, given_options(context))
    return Wanted(scene, group, folder, flags, options)


def trained(runs, jobs, gpus):
    """({scene name: {group: list of Trained}} of the runs that are there now, folders that failed).

    runs: list of Wanted, in the order to train them. Raises InputError, before any training, for a
    folder that holds another run.
    """
    folders = [run.folder for run in runs]
    for run in runs:
        if folders.count(run.folder) > 1:
            raise InputError(f"{run.folder}: would hold two runs; give scenes and columns names "
                             "that differ")
    places = {run: held(run) for run in runs}
    missing = [run for run, place in places.items() if place is None]
    print(f"{len(runs)} runs, {len(runs) - len(missing)} of them finished before", flush=True)
    for number, (run, code) in enumerate(_train(missing, jobs, gpus), 1):
        places[run] = None if code else run.folder
        print(f"[{number}/{len(missing)}] {run.folder}: {'failed' if code else 'finished'}",
              flush=True)
    found = {}
    for run, place in places.items():
        group = found.setdefault(run.scene.name, {}).setdefault(run.group, [])
        if place:
            read = Run.open(place)
            group.append(Trained(str(place), read.record, read.metrics, True))
    return found, [run.folder for run, place in places.items() if place is None]


def held(run):
    """The folder of a finished run with the options of a Wanted, or None."""
    for file in [run.folder / OPTIONS, *sorted(run.folder.parent.glob(f"*/{OPTIONS}"))]:
        if file.is_file():
            there = RunFolder.open(file.parent)
            other = _difference(there.read_options(), run)
            if not other and there.has_model:
                return file.parent
            if other and file.parent == run.folder:
                raise InputError(f"{run.folder}: holds a run with {other}; choose another OUT, or "
                                 "remove that folder")
    return None


def _difference(record, run):
    """In which option, in words, a run's record differs from a Wanted; None if it can serve."""
    scene = str(Path(run.scene.path).resolve())
    if record.get("scene_absolute") != scene:
        return f"scene_absolute {record.get('scene_absolute')}, not {scene}"
    for name, there, here in differences(record, run.options):
        if name != "eval_at" or not set(here) <= set(there or ()):
            return f"{name} {there}, not {here}"
    return None


def _train(runs, jobs, gpus):
    """Yields (Wanted, exit code) as they end."""
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
        except BaseException:  # Ctrl-C: those under way save their state, no others begin
            pool.shutdown(wait=False, cancel_futures=True)
            raise
