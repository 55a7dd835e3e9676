"""The end of a city: one model of its blocks, and its scores."""

import logging
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.cities.cut import draw
from clsplat.cities.joint import train_jointly
from clsplat.cities.merge import Merged, merge
from clsplat.cities.seams import find_seams
from clsplat.cities.tree import merge_tree
from clsplat.device import Device
from clsplat.errors import InputError, OutOfDeviceMemory
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import (
    evaluate_run,
    final_metrics,
    training_pictures,
)
from clsplat.io.georeference.files import placement_comments, write_placement
from clsplat.io.models.ply import read_ply
from clsplat.io.models.tree import TREE
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.options import TrainOptions
from clsplat.report.run import write_report
from clsplat.scene import Scene
from clsplat.training.loop import run_record
from clsplat.training.progress import SilentProgress

log = logging.getLogger(__name__)
SPENT = ("iteration", "train_seconds", "wall_seconds")


def reference_file(against: Path | None, tree: bool) -> Path | None:
    """The PLY of `--against`, which is a finished run or a PLY file; InputError for others, and
    with a tree, of which nothing is evaluated."""
    if against is None:
        return None
    if tree:
        raise InputError("--against: has no effect with --tree, which measures no seams; leave one "
                         "of them out")
    path = RunFolder(against).model_path if against.is_dir() else against
    if not path.is_file():
        raise InputError(f"--against {against}: " + (
            f"has no {path.name}; give a finished run, or a PLY file" if against.is_dir()
            else "no such file; give a PLY file, or a finished run"))
    read_ply(path)
    return path


def merged_city(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                fill: bool = False, progress: SilentProgress | None = None, joint: bool = True
                ) -> Merged:
    """Merge the blocks of a city into its model, and train that jointly.

    A tree of an earlier merge is removed, since it may be of other blocks.

    Parameters
    ----------
    city : its folder.
    scene : the whole, as `read_scene` returns it.
    options : of the whole.
    device : of the joint training; its name is recorded.
    fill : see `merge.merge`.
    progress : of the joint training.
    joint : whether there is one, where the partition includes it.

    Returns
    -------
    The blocks, with the gaussians of the joint training where there is one.

    Raises
    ------
    InputError : a block is missing; nothing is written then.
    Interrupted : the joint training was stopped; its state is saved.
    """
    merged = merge(city, scene, fill)
    merged.check()
    run = RunFolder(city.path)
    if joint:
        merged = _trained_jointly(city, scene, options, device, merged, progress)
    (run.path / TREE).unlink(missing_ok=True)
    _note_merge(city, scene, options, device, merged, joint)
    run.save_model(merged.gaussians, scene.offset, (
        f"merged of {len(merged.shares)} blocks",
        *placement_comments(scene.up, scene.georeference)))
    return merged


def _trained_jointly(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                     merged: Merged, progress: SilentProgress | None) -> Merged:
    """The model after its joint training, or as it was merged where the device cannot hold it."""
    try:
        return train_jointly(city, scene, options, merged, device, progress)
    except OutOfDeviceMemory:
        log.warning("%s: there is no joint training, as the whole model does not fit the device",
                    city.path)
        shutil.rmtree(city.joint, ignore_errors=True)
        return merged


def merge_city_tree(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                    fill: bool = False) -> Merged:
    """Merge the blocks of a city into its tree, with one block at a time in memory.

    A model and scores of an earlier merge stay. Arguments and errors as for `merged_city`.
    """
    merged = merge_tree(city.path / TREE, city, scene, options.sh_degree, fill)
    if not RunFolder(city.path).has_model:
        _note_merge(city, scene, options, device, merged)
    return merged


def _note_merge(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                merged: Merged, joint: bool = False) -> None:
    """Make the city's folder a run, with the record of a merge and the learned exposures.

    Parameters
    ----------
    joint : whether a joint training, if there was one, is a part of the model.
    """
    run = RunFolder(city.path)
    coarse, trained = RunFolder(city.coarse), RunFolder(city.joint)
    joint = joint and trained.has_model
    jointly = cost([trained] * joint)
    spent = cost([coarse, *(RunFolder(block.run) for block in city.blocks()), *[trained] * joint])
    run.write_options({**run_record(scene, options, device), "blocks": len(merged.shares)})
    write_placement(run.path, scene, first_view=True)
    run.rewind(-1)
    run.log({"event": "merge", **spent, "level": 1.0, "joint_steps": jointly["iteration"],
             **merged.record()})
    if responses := (trained if joint else coarse).load_exposures():
        run.save_exposures(responses)


def evaluate_city(city: CityFolder, options: TrainOptions, device: Device, merged: Merged,
                  against: Path | None = None
                  ) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    """Score the merged model on the held-out views, measure its seams, and write the report.

    Parameters
    ----------
    city : its folder, merged.
    options : of the whole.
    device : an open device.
    merged : that of `merged_city`.
    against : the PLY file of the reference for seams; None: that of the coarse model.

    Returns
    -------
    The result of `evaluate_run`, None without held-out views; and the result of `find_seams`, by
    the training views where none are held out, None for a single block.
    """
    run, record = Run.open(city.path), merge_record(city)
    spent = {key: record[key] for key in (*SPENT, "level", "gaussians")}
    counts = np.array([share.gaussians for share in merged.shares])
    scores = seams = None
    whole = run.scene(whole=True)
    scene = run.as_trained(whole)
    train, test = scene.split(options.test_every, options.test_offset)
    if test:
        scores = evaluate_run(run, device, save_images=False, metrics=final_metrics(options.lpips),
                              gaussians=merged.gaussians)
        run.folder.log({"event": "eval", **spent, **{key: value for key, value in scores.items()
                                                     if key not in ("per_view", "pictures")}})
    partition = city.partition(scene)
    if not city.picture.is_file():
        draw(city, partition, scene, counts)
    if len(counts) > 1:
        reference = read_ply(against or RunFolder(city.coarse).model_path, scene.offset)
        seams = find_seams(device, partition, scene, test or train, options, merged.gaussians,
                           reference.without_spheres())
        run.folder.log({"event": "seams", **spent, "seam_db": seams["seam_db"],
                        "worst_seam_db": seams["worst_seam_db"], "borders": seams["borders"]})
    write_report(run.folder, scores["pictures"] if scores else training_pictures(run, device),
                 whole)
    return scores, seams


def merge_record(city: CityFolder) -> dict[str, Any]:
    """The latest record of a merge in the city's metrics."""
    return [record for record in RunFolder(city.path).records() if record["event"] == "merge"][-1]


def cost(runs: Iterable[RunFolder]) -> dict[str, float]:
    """{iteration, train_seconds, wall_seconds}: sums over runs."""
    last = [record for run in runs for record in run.past_records()[-1:]]
    return {key: round(sum(record.get(key) or 0 for record in last), 3) for key in SPENT}
