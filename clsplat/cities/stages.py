"""The first stages of a city: begin, and train the coarse run; cut.py and blocks.py follow."""

import dataclasses
from pathlib import Path

from clsplat.config.option import AUTO, differences
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import final_metrics
from clsplat.io.folders import make_folder
from clsplat.io.photos.depth import with_depths
from clsplat.io.photos.undistort import undistorted
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.origin import recorded_scene, scene_record
from clsplat.io.runs.run import CITY, RunFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import TrainOptions, checked_values, resolve
from clsplat.scene import Scene
from clsplat.schedule import chooses_steps, worthwhile_steps
from clsplat.training.loop import resume, train
from clsplat.training.photos import THREADS
from clsplat.training.progress import SilentProgress
from clsplat.training.start.prepare import scene_facts

COARSE_FACTOR = 2  # the coarse run's photos are smaller by this
# of the steps of one run; at half size they cost a quarter or less. A joint training needs fewer
COARSE_SHARE, COARSE_SHARE_BEFORE_JOINT = 0.5, 0.25


def begin(city: CityFolder, scene: Scene, options: TrainOptions) -> None:
    """Write the scene and the options of the whole into city.json.

    Raises
    ------
    InputError : the folder holds a city of another scene, or one with other options; or the
        network of `options.lpips` cannot be read; or the options correct poses.
    """
    if options.poses == "on":
        raise InputError("--poses on: is for single runs; the blocks of a city would correct the "
                         "same poses differently, so leave it out")
    final_metrics(options.lpips)  # a network that cannot be read is refused before the work
    record = {**scene_record(scene.path, city.path), "fingerprint": fingerprint(scene),
              "options": dataclasses.asdict(options)}
    if city.has_record:
        earlier = city.read(options=dict)
        if earlier["fingerprint"] != record["fingerprint"]:
            raise InputError(f"{city.path}: is the city of another scene, "
                             f"{earlier.get('scene_absolute')}; choose another --output")
        changed = next(differences(earlier["options"], options), None)
        if changed and RunFolder(city.coarse).is_begun:  # else they have not been used yet
            raise InputError(f"{city.path}: was begun with {changed[0]} {changed[1]}; give the "
                             "same options, or choose another --output")
    else:
        city.check_free()
    make_folder(city.path, "choose another --output")
    city.write(record)


def begin_from_coarse(city: CityFolder, scene_path: Path | None = None
                      ) -> tuple[Scene, TrainOptions]:
    """The scene of a city, and the options of the whole, from city.json.

    That file is written here if the coarse run in CITY/coarse was trained by itself.

    Parameters
    ----------
    scene_path : where the scene is now, if it was moved.
    """
    if city.has_record:
        record = city.read(scene=str, options=dict)
        options = resolve({}, checked_values(str(city.path / CITY), record["options"]))
        scene = read_scene(recorded_scene(record, city.path, scene_path), options.images)
        if fingerprint(scene) != record["fingerprint"]:
            raise InputError(f"{city.path}: its scene {scene.path} has changed since; put it "
                             "back, or begin a new city")
        return scene, options
    run = Run.open(city.coarse)
    coarse = run.options
    if not coarse.coarse:
        raise InputError(f"{city.coarse}: was not trained with --coarse; begin again with "
                         f"`clsplat train SCENE --coarse -o {city.coarse}`")
    scene = run.scene(scene_path, whole=True)
    options = dataclasses.replace(
        coarse, coarse=False, snapshots=False, downscale=max(1.0, coarse.downscale / COARSE_FACTOR),
        max_resolution=COARSE_FACTOR * coarse.max_resolution,
        iterations=(int(coarse.iterations / COARSE_SHARE) if chooses_steps(coarse) else
                    coarse.iterations))
    begin(city, scene, options)
    return scene, options


def train_coarse(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                 progress: SilentProgress | None = None, joint: bool = False) -> RunFolder:
    """Train the coarse model in CITY/coarse, or continue its training; return its folder.

    Parameters
    ----------
    city : its folder.
    scene, options : the whole.
    device : an open device.
    progress : receives steps, messages and phases.
    joint : whether the city will be trained jointly.
    """
    folder = RunFolder(city.coarse)
    if folder.is_begun and folder.read_options().get("fingerprint") != fingerprint(scene):
        raise InputError(f"{folder.path}: is a run of another scene; choose another --output")
    if folder.is_finished:
        return folder
    scene = undistorted(with_depths(scene, options.depth), city.undistorted, THREADS)
    coarse = coarse_options(options, scene, joint)
    with folder.locked():
        if folder.is_begun:  # as it was begun: on another device there may be no joint training
            steps = Run.open(folder.path).options.iterations
            resume(scene, dataclasses.replace(coarse, iterations=steps), device, folder, progress)
        else:
            folder = RunFolder.create(city.coarse)
            train(scene, coarse, device, folder, progress)
    return folder


def coarse_options(options: TrainOptions, scene: Scene, joint: bool = False) -> TrainOptions:
    """The options of the coarse run: photos half as large as the blocks', and a half or a quarter
    of the steps of one run; it begins at the sparse points.

    Parameters
    ----------
    options, scene : the whole.
    joint : whether the city will be trained jointly.
    """
    training, _ = scene.split(options.test_every, options.test_offset)
    one_run, _, _ = worthwhile_steps(options, scene_facts(scene, training), len(training))
    share = COARSE_SHARE_BEFORE_JOINT if joint else COARSE_SHARE
    return dataclasses.replace(
        options, coarse=True, snapshots=False, init=AUTO,
        downscale=COARSE_FACTOR * options.downscale,
        max_resolution=-(-options.max_resolution // COARSE_FACTOR),
        iterations=max(1, int(share * one_run)), eval_at=(),
        eval_every=0, lpips="")
