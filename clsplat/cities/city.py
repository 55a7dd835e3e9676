"""A city and its first stages, begin and the coarse run; dense.py, cut.py and block.py follow."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from clsplat.cities.jobs import HERE
from clsplat.config.option import AUTO, differences, is_auto
from clsplat.device import Device, choose_device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.io.folders import make_folder
from clsplat.io.models.ply import read_ply
from clsplat.io.photos.depth import with_depths
from clsplat.io.photos.undistort import undistorted
from clsplat.io.runs.city import CityFolder, StageTime
from clsplat.io.runs.origin import recorded_scene, scene_record
from clsplat.io.runs.run import CITY, RunFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import TrainOptions, checked_values, resolve
from clsplat.scene import Scene
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.steps import worthwhile_steps
from clsplat.training.photos import THREADS
from clsplat.training.progress import SilentProgress
from clsplat.training.run import training_of
from clsplat.training.start.prepare import scene_facts

COARSE_FACTOR = 2  # the coarse run's photos are smaller by this
# of the steps of one run; at half size they cost a quarter or less. A joint training needs fewer
COARSE_SHARE, COARSE_SHARE_BEFORE_JOINT = 0.5, 0.25
LEAST_SECONDS = 0.1  # of a stage: less is one that was done before


class Shown:
    """Receives what a city does, and shows nothing; a subclass shows it."""

    def stage(self, title: str) -> AbstractContextManager[SilentProgress | None]:
        """The progress of a stage, such as "coarse run" or "block 2 of 9"."""
        return nullcontext()

    def line(self, text: str) -> None:
        """A line, or a table, that stays."""

    def failure(self, text: str) -> None:
        """A line about a block that failed, or an option without effect."""


@contextmanager
def timed(folder: CityFolder, name: str) -> Iterator[None]:
    """Record in the city's folder when the block was done, unless there was nothing to do."""
    began = time.time()
    yield
    if (seconds := time.time() - began) > LEAST_SECONDS:
        folder.add_stage(StageTime(name, HERE, began, seconds))


@dataclass(frozen=True, eq=False)
class City:
    """A large scene that is trained in blocks.

    Attributes
    ----------
    folder : where its files are.
    scene : the whole, as `read_scene` returns it.
    options : of the whole.
    device : an open device, for what is not trained in blocks.
    """

    folder: CityFolder
    scene: Scene
    options: TrainOptions
    device: Device

    @classmethod
    def open(cls, folder: CityFolder, scene_path: Path | None = None, device: str | Device = "") -> City:
        """A city that was begun, or that begins here with the coarse run in CITY/coarse.

        `scene_path` : where the scene is now, if it was moved; `device` : its name, "" for that of
        the options, or an open one.
        """
        if begun := folder.has_record:
            record = folder.read(scene=str, options=dict)
            options = resolve({}, checked_values(str(folder.path / CITY), record["options"]))
            scene = read_scene(recorded_scene(record, folder.path, scene_path), options.images)
            if fingerprint(scene) != record["fingerprint"]:
                raise InputError(
                    f"{folder.path}: its scene {scene.path} has changed since; put it back, or begin a new city"
                )
        else:
            run = Run.open(folder.coarse)
            options, scene = _options_before(run), run.scene(scene_path, whole=True)
        if not isinstance(device, Device):
            device = choose_device(device) if device else choose_device(options.device, form=options.form)
        city = cls(folder, scene, options, device)
        if not begun:
            city.begin()
        return city

    @cached_property
    def pinhole(self) -> Scene:
        """The scene as it is trained: with depth maps, and photos without distortion."""
        return undistorted(with_depths(self.scene, self.options.depth), self.folder.undistorted, THREADS)

    def begin(self) -> None:
        """Write the scene and the options of the whole into city.json.

        InputError for a folder of another scene or with other options, and for options that correct
        poses."""
        folder, options = self.folder, self.options
        if options.poses == "on":
            raise InputError(
                "--poses on: is for single runs; the blocks of a city would correct "
                "the same poses differently, so leave it out"
            )
        record = {
            **scene_record(self.scene.path, folder.path),
            "fingerprint": fingerprint(self.scene),
            "options": dataclasses.asdict(options),
        }
        if folder.has_record:
            earlier = folder.read(options=dict)
            if earlier["fingerprint"] != record["fingerprint"]:
                raise InputError(
                    f"{folder.path}: is the city of another scene, "
                    f"{earlier.get('scene_absolute')}; choose another --output"
                )
            changed = next(differences(earlier["options"], options), None)
            if changed and RunFolder(folder.coarse).is_begun:  # else they have not been used yet
                raise InputError(
                    f"{folder.path}: was begun with {changed[0]} {changed[1]}; give "
                    "the same options, or choose another --output"
                )
        make_folder(folder.path, "choose another --output")
        folder.write(record)

    @cached_property
    def one_run(self) -> tuple[int, SceneFacts]:
        """The steps that one run of `pinhole` takes, and its facts."""
        views, _ = self.pinhole.split(self.options.test_every, self.options.test_offset)
        facts = scene_facts(self.pinhole, views)
        return worthwhile_steps(self.options, facts, len(views))[0], facts

    def dense_gaussians(self, sh_degree: int) -> Gaussians | None:
        """The gaussians of CITY/dense.ply in the scene's frame; None without that file."""
        if not self.folder.dense.is_file():
            return None
        return read_ply(self.folder.dense, self.scene.offset).with_sh_degree(sh_degree)


def train_coarse(city: City, progress: SilentProgress | None = None, joint: bool = False) -> RunFolder:
    """Train the coarse model in CITY/coarse, or continue its training; return its folder.

    `joint` : whether the city will be trained jointly.
    """
    folder = RunFolder(city.folder.coarse)
    if folder.is_finished:
        return folder
    coarse = coarse_options(city, joint)
    with folder.locked():
        if folder.is_begun:  # as it was begun: on another device there may be no joint training
            coarse = dataclasses.replace(coarse, iterations=Run.open(folder.path).options.iterations)
        training_of(city.pinhole, coarse, city.device, folder, progress).take()
    return folder


def coarse_options(city: City, joint: bool = False) -> TrainOptions:
    """The options of the coarse run: photos half as large as the blocks', and a half or a quarter
    of the steps of one run; it begins at the sparse points.

    `joint` : whether the city will be trained jointly.
    """
    options, (one_run, _) = city.options, city.one_run
    share = COARSE_SHARE_BEFORE_JOINT if joint else COARSE_SHARE
    return dataclasses.replace(
        options,
        coarse=True,
        init=AUTO,
        downscale=COARSE_FACTOR * options.downscale,
        max_resolution=-(-options.max_resolution // COARSE_FACTOR),
        iterations=max(1, int(share * one_run)),
        eval_every=0,
    )


def _options_before(run: Run) -> TrainOptions:
    """The options of the whole, of which a run by itself is the coarse run."""
    coarse = run.options
    if not coarse.coarse:
        raise InputError(
            f"{run.path}: was not trained with --coarse; begin again with `clsplat train SCENE --coarse -o {run.path}`"
        )
    return dataclasses.replace(
        coarse,
        coarse=False,
        downscale=max(1.0, coarse.downscale / COARSE_FACTOR),
        max_resolution=COARSE_FACTOR * coarse.max_resolution,
        iterations=(coarse.iterations if is_auto(coarse.iterations) else int(coarse.iterations / COARSE_SHARE)),
    )
