"""The end of a city: one model of its blocks, and its scores."""

import logging
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.cities.city import City
from clsplat.cities.cut import draw
from clsplat.cities.joint import train_jointly
from clsplat.cities.merge import Merged, merge
from clsplat.cities.seams import find_seams
from clsplat.cities.tree import merge_tree
from clsplat.errors import InputError, OutOfDeviceMemory
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import evaluate_run, final_metrics, training_pictures
from clsplat.io.georeference.files import placement_comments, write_placement
from clsplat.io.models.ply import read_ply
from clsplat.io.models.tree import TREE
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.report.run import write_report
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


def merged_city(city: City, fill: bool = False, progress: SilentProgress | None = None,
                joint: bool = True) -> Merged:
    """Merge the blocks of a city into its model, and train that jointly.

    A tree of an earlier merge is removed, since it may be of other blocks.

    Parameters
    ----------
    fill : see `merge.merge`.
    progress, joint : of the joint training; whether there is one, if the partition includes it.

    Raises
    ------
    InputError : a block is missing; nothing is written then.
    Interrupted : the joint training was stopped; its state is saved.
    """
    merged = merge(city.folder, city.scene, fill)
    merged.check()
    run, scene = RunFolder(city.folder.path), city.scene
    if joint:
        try:
            merged = train_jointly(city, merged, progress)
        except OutOfDeviceMemory:
            log.warning("%s: there is no joint training, as the whole model does not fit the "
                        "device", run.path)
            shutil.rmtree(city.folder.joint, ignore_errors=True)
    (run.path / TREE).unlink(missing_ok=True)
    _note_merge(city, merged, joint)
    run.save_model(merged.gaussians, scene.offset, (
        f"merged of {len(merged.shares)} blocks",
        *placement_comments(scene.up, scene.georeference)))
    return merged


def merge_city_tree(city: City, fill: bool = False) -> Merged:
    """Merge the blocks of a city into its tree, with one block at a time in memory.

    A model and scores of an earlier merge stay. Arguments and errors as for `merged_city`.
    """
    folder = city.folder
    merged = merge_tree(folder.path / TREE, folder, city.scene, city.options.sh_degree, fill)
    if not RunFolder(folder.path).has_model:
        _note_merge(city, merged)
    return merged


def _note_merge(city: City, merged: Merged, joint: bool = False) -> None:
    """Make the city's folder a run, with the record of a merge and the learned exposures; `joint`:
    whether a joint training, if there was one, is in the model."""
    folder, scene, run = city.folder, city.scene, RunFolder(city.folder.path)
    coarse, trained = RunFolder(folder.coarse), RunFolder(folder.joint)
    joint = joint and trained.has_model
    blocks = [RunFolder(block.run) for block in folder.blocks()]
    run.write_options({**run_record(scene, city.options, city.device),
                       "blocks": len(merged.shares)})
    write_placement(run.path, scene, first_view=True)
    run.rewind(-1)
    run.log({"event": "merge", **_cost([coarse, *blocks, *[trained] * joint]), "level": 1.0,
             "joint_steps": _cost([trained] * joint)["iteration"], **merged.record()})
    if responses := (trained if joint else coarse).load_exposures():
        run.save_exposures(responses)


def evaluate_city(city: City, merged: Merged, against: Path | None = None
                  ) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    """Score the merged model on the held-out views, measure its seams, and write the report.

    `against` : the PLY file of the reference for seams; None: that of the coarse model. Returns the
    result of `evaluate_run`, None without held-out views; and that of `find_seams`, by the training
    views where none are held out, None for a single block."""
    folder, options = city.folder, city.options
    run, record = Run.open(folder.path), merge_record(folder)
    spent = {key: record[key] for key in (*SPENT, "level", "gaussians")}
    counts = np.array([share.gaussians for share in merged.shares])
    scores = seams = None
    whole = run.scene(whole=True)
    scene = run.as_trained(whole)
    train, test = scene.split(options.test_every, options.test_offset)
    if test:
        scores = evaluate_run(run, city.device, save_images=False,
                              metrics=final_metrics(options.lpips), gaussians=merged.gaussians)
        run.folder.log({"event": "eval", **spent, **{key: value for key, value in scores.items()
                                                     if key not in ("per_view", "pictures")}})
    partition = folder.partition(scene)
    if not folder.picture.is_file():
        draw(folder, partition, scene, counts)
    if len(counts) > 1:
        reference = read_ply(against or RunFolder(folder.coarse).model_path, scene.offset)
        seams = find_seams(city.device, partition, scene, test or train, options,
                           merged.gaussians, reference.without_spheres())
        run.folder.log({"event": "seams", **spent, "seam_db": seams["seam_db"],
                        "worst_seam_db": seams["worst_seam_db"], "borders": seams["borders"]})
    write_report(run.folder, scores["pictures"] if scores else training_pictures(run, city.device),
                 whole)
    return scores, seams


def merge_record(city: CityFolder) -> dict[str, Any]:
    """The latest record of a merge in the city's metrics."""
    return [record for record in RunFolder(city.path).records() if record["event"] == "merge"][-1]


def _cost(runs: Iterable[RunFolder]) -> dict[str, float]:
    """{iteration, train_seconds, wall_seconds}: sums over runs."""
    last = [record for run in runs for record in run.past_records()[-1:]]
    return {key: round(sum(record.get(key) or 0 for record in last), 3) for key in SPENT}
