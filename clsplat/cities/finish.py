"""The end of a city: one model of its blocks, its joint training, and its scores.

Blocks learn apart from each other, under surroundings that are those of the coarse run. Where a
device holds the whole model, steps on whole photos remove what that leaves: seams, and gaussians
that only one block needed. The training begins at points of the blocks' gaussians and at dense
points, as one run does: with the shapes and opacities of the blocks it ends in a worse model
(docs/evidence/cities.md).
"""

import dataclasses
import filecmp
import logging
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.cities.city import City
from clsplat.cities.cut import JOINT, draw
from clsplat.cities.merge import Merged, merge
from clsplat.cities.scene import Stage
from clsplat.cities.seams import find_seams
from clsplat.cities.tree import merge_tree
from clsplat.errors import InputError, OutOfDeviceMemory
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import evaluate_run, final_metrics, training_pictures
from clsplat.gaussians import Gaussians
from clsplat.io.georeference.files import placement_comments, write_placement
from clsplat.io.models.ply import read_ply, start_of, write_ply
from clsplat.io.models.tree import TREE
from clsplat.io.models.values import colours_of, to_bytes
from clsplat.io.records import digest_of
from clsplat.io.runs.city import PARTITION, CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.options import TrainOptions, of_file, resolve
from clsplat.partition.input import world_of
from clsplat.report.run import write_report
from clsplat.training.loop import resume, train, trained_on
from clsplat.training.part import Part
from clsplat.training.parts.exposures import PhotoResponses
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
    run.write_options({**dataclasses.asdict(city.options),
                       **trained_on(scene, city.options.init, city.device),
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


def train_jointly(city: City, merged: Merged, progress: SilentProgress | None = None) -> Merged:
    """Train a city as a whole in CITY/joint, or continue that.

    That of another merged model, or of another partition without one, is removed. Returns the
    blocks with the gaussians that now lie in their cells; `merged` if the partition has no joint
    training. Raises Interrupted, with the state saved, and DeviceError for a model too large."""
    folder, scene = city.folder, city.scene
    given, run = folder.read_partition().get(JOINT), RunFolder(folder.joint)
    if not given:
        shutil.rmtree(run.path, ignore_errors=True)
        return merged
    begin_with(city, merged.gaussians)
    if not run.has_model:
        together = joint_options(city, given, merged.count)
        parts: list[Part] = [Stage()]
        if together.exposure == "on":
            parts.append(PhotoResponses(RunFolder(folder.coarse).load_exposures()))
        with run.locked():
            start = resume if run.is_begun else train
            start(dataclasses.replace(city.pinhole, notes=()), together, city.device,
                  run if run.is_begun else RunFolder.create(folder.joint), progress, parts=parts)
    if (began := start_of(run.model_path)) and began != digest_of(folder.joint_start):
        raise InputError(f"{run.path}: is the joint training of another city or partition, as it "
                         f"did not begin at {folder.joint_start}; remove it, and give the same "
                         "command again")
    gaussians = run.load_model(scene.offset)
    owner = folder.partition(scene).owner(world_of(scene, gaussians.positions))
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=len(merged.shares))
    return dataclasses.replace(
        merged, gaussians=Gaussians({name: rows[order] for name, rows in gaussians.rows.items()},
                                    gaussians.sh_degree),
        shares=tuple(dataclasses.replace(share, gaussians=int(counts[share.block]))
                     for share in merged.shares))


def begin_with(city: City, merged: Gaussians) -> None:
    """Write the points at which the joint training begins; remove that of other ones.

    They are half of the points of the merged gaussians and half of the dense points of the city,
    drawn at random; all of the former in a city without dense points.
    """
    folder, dense = city.folder, city.dense_gaussians(0)
    rng = np.random.default_rng([city.options.seed, 0])
    parts = [merged, dense] if dense else [merged]
    chosen = [rng.random(part.count) < 1 / len(parts) for part in parts]
    positions, constant = (np.concatenate([part.rows[name][which]
                                           for part, which in zip(parts, chosen)])
                           for name in ("positions", "sh_constant"))
    new = folder.joint_start.with_suffix(".new.ply")
    write_ply(new, Gaussians.from_points(positions, to_bytes(255 * colours_of(constant)),
                                         sh_degree=0), city.scene.offset)
    if not (folder.joint_start.is_file() and filecmp.cmp(new, folder.joint_start, shallow=False)):
        shutil.rmtree(folder.joint, ignore_errors=True)
    os.replace(new, folder.joint_start)


def joint_options(city: City, given: Any, count: int) -> TrainOptions:
    """The options of the joint training, from those `given` in partition.json.

    A limit of gaussians is one of each block, so the merged model of `count` may have more; it does
    not grow then. The same views are held out as of one run."""
    path = city.folder.path / PARTITION
    if not isinstance(given, dict):
        raise InputError(f"{path}: damaged ({JOINT} is {str(given)[:20]!r}); remove it, and make "
                         f"it with `clsplat partition {city.folder.path}`")
    joint = resolve(of_file(str(path), given), {"init": str(city.folder.joint_start)})
    most = joint.max_gaussians and max(joint.max_gaussians, count)
    return dataclasses.replace(joint, max_gaussians=most, test_every=city.options.test_every,
                               test_offset=city.options.test_offset)
