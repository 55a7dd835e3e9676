"""The end of a city: one model of its blocks, its joint training, and its scores.

Each block is cropped to its cell, so that every gaussian is owned once: its margin belongs to its
neighbours. Missing blocks are listed, never ignored.

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
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.cities.city import City, timed
from clsplat.cities.cut import JOINT, requested_of
from clsplat.cities.scene import Stage
from clsplat.cities.seams import find_seams
from clsplat.cities.tree import TreeBuilder
from clsplat.errors import InputError, OutOfDeviceMemory
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import METRICS, evaluate_run, opened, training_pictures
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.atomic import replacing
from clsplat.io.georeference.files import placement_comments, write_placement
from clsplat.io.lock import LockTaken, check_unlocked
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.io.models.tree import TREE, writing_tree
from clsplat.io.models.values import colours_of, to_bytes
from clsplat.io.runs.city import PARTITION, BlockFolder, CityFolder
from clsplat.io.runs.run import RunFolder, read_exposures, write_exposures
from clsplat.options import TrainOptions, checked_values, resolve
from clsplat.partition.region import Partition, world_of
from clsplat.report.figures.map import write_map
from clsplat.report.run import write_report
from clsplat.scene import Scene
from clsplat.training.part import Part
from clsplat.training.parts.exposures import PhotoResponses
from clsplat.training.progress import SilentProgress
from clsplat.training.run import training_of
from clsplat.training.start.begin import trained_on

READ_TOGETHER = 4  # blocks, where all of them will be in memory
FILLED = ("merged", "coarse")  # states of a block whose cell is filled
TRAINS = "in training"  # by another process, at this moment
NEVER_FILLED = (TRAINS, "refused")  # states of a block, whose note has the cure
SPENT = ("iteration", "train_seconds", "wall_seconds")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Share:
    """The part of a block in the merged model.

    Attributes
    ----------
    block : its number.
    state : merged; coarse, if the coarse model's gaussians are in its place; or the reason why it
        has no part: missing, unfinished, in training, refused.
    gaussians, trained : numbers of its gaussians in the merged model, and in its own, which has a
        margin.
    views, points : numbers of its training views, and of sparse points in its cell.
    note : an explanation for people.
    """

    block: int
    state: str
    gaussians: int
    trained: int
    views: int
    points: int
    note: str = ""


@dataclass(frozen=True, eq=False)
class Merged:
    """Blocks as one model, which may have holes.

    Attributes
    ----------
    gaussians : in the frame of the whole scene, block after block; none if they were kept
        elsewhere.
    shares : one for each block, in the same order.
    dropped : name of a view -> the reason why no block has it.
    path : the folder of the city.
    """

    gaussians: Gaussians
    shares: tuple[Share, ...]
    dropped: dict[str, str]
    path: Path

    def check(self) -> None:
        """Raise an InputError that names all cells that are empty but should not be."""
        lacking = [share for share in self.shares if share.state not in FILLED]
        if not lacking:
            return
        named = ", ".join(f"{share.block:03d} {share.state}" for share in lacking)
        cure = next(
            (share.note for share in lacking if share.state in NEVER_FILLED),
            (
                f"see `clsplat block {self.path}/blocks/{lacking[0].block:03d}`, give `clsplat city` "
                "again, or fill them from the coarse model with --fill"
            ),
        )
        raise InputError(f"{self.path}: {len(lacking)} of {len(self.shares)} blocks cannot be merged: {named}; {cure}")

    @property
    def count(self) -> int:
        """How many gaussians the model has."""
        return sum(share.gaussians for share in self.shares)

    def record(self) -> dict[str, Any]:
        """A dict for JSON."""
        return {"blocks": [asdict(share) for share in self.shares], "dropped": self.dropped, "gaussians": self.count}


def merge(
    city: CityFolder, scene: Scene, fill: bool = False, keep: Callable[[Gaussians], object] | None = None
) -> Merged:
    """Merge the finished blocks of a city; `Merged.check` says whether the model has holes.

    Parameters
    ----------
    city, scene : its folder; the whole, as `read_scene` returns it.
    fill : take the coarse model's gaussians for blocks that are missing or unfinished, but not for
        a block that another process trains at this moment.
    keep : called with the gaussians of each block, one at a time in memory; None: they are joined.

    Raises
    ------
    InputError : a damaged partition, or block folders of another partition.
    """
    partition = city.partition(scene)
    for folder in city.blocks():
        number = folder.read()["number"]
        if folder.path != city.block(number).path or not 0 <= number < len(partition.regions):
            raise InputError(
                f"{folder.path}: says that it is block {number} of "
                f"{len(partition.regions)}; two partitions are mixed here: remove the "
                "folders of the other one"
            )
    owner = partition.owner(world_of(scene, scene.points))
    points = np.bincount(owner[owner >= 0], minlength=len(partition.regions))
    pieces: list[Gaussians] = []
    shares, coarse = [], None
    blocks = ((city.block(number), number, partition, scene) for number in range(len(partition.regions)))
    together = 1 if keep else READ_TOGETHER
    found = called_ahead(_block, blocks, together, together)
    keep = keep or pieces.append
    for number, views in enumerate(partition.views):
        state, trained, piece, note = next(found)
        if fill and state not in ("merged", *NEVER_FILLED):
            coarse = coarse or RunFolder(city.coarse).load_model(scene.offset)
            piece = cropped(coarse, partition, number, scene.offset)
            state, note = "coarse", f"{state}: {note}"
        shares.append(Share(number, state, piece.count if piece else 0, trained, len(views), int(points[number]), note))
        if piece:
            keep(piece)
        del piece  # else it is in memory beside the next one
    dropped = {scene.views[view].name: reason for view, reason in partition.dropped.items()}
    return Merged(joined(pieces), tuple(shares), dropped, city.path)


def cropped(gaussians: Gaussians, partition: Partition, number: int, offset: NDArray[np.float64]) -> Gaussians:
    """The gaussians that block `number` owns; world = their coordinates + `offset` [3]."""
    kept = partition.owner(gaussians.positions.astype(np.float64) + offset) == number
    return Gaussians({f.name: gaussians.rows[f.name][kept] for f in LEARNED}, gaussians.sh_degree)


def joined(pieces: list[Gaussians]) -> Gaussians:
    """One model of several, in order, with the highest SH degree among them.

    The pieces' rows are removed one field after the other, to save memory.
    """
    degree = max((piece.sh_degree for piece in pieces), default=0)
    pieces = [piece.with_sh_degree(degree) for piece in pieces]
    return Gaussians(
        {
            field.name: np.concatenate(
                [piece.rows.pop(field.name) for piece in pieces]
                or [np.empty((0, *field.row_shape(degree)), np.float32)]
            )
            for field in LEARNED
        },
        degree,
    )


def _block(
    folder: BlockFolder, number: int, partition: Partition, scene: Scene
) -> tuple[str, int, Gaussians | None, str]:
    """The state of a block, its number of trained gaussians, those of its cell, and a note."""
    if not folder.is_there:
        return "missing", 0, None, "it was never written"
    run = RunFolder(folder.run)
    if not run.has_model:
        try:
            check_unlocked(folder.run)
        except LockTaken as error:
            return TRAINS, 0, None, str(error)
        return "unfinished", 0, None, "its run has no model yet"
    try:
        folder.check()
        folder.check_own(run.model_path)
        gaussians = run.load_model(scene.offset)
    except InputError as error:
        return "refused", 0, None, str(error)
    piece = cropped(gaussians, partition, number, scene.offset)
    return "merged", gaussians.count, piece, ""


def reference_file(against: Path | None, tree: bool) -> Path | None:
    """The PLY of `--against`, which is a finished run or a PLY file; InputError for others, and
    with a tree, of which nothing is evaluated."""
    if against is None:
        return None
    if tree:
        raise InputError("--against: has no effect with --tree, which measures no seams; leave one of them out")
    path = RunFolder(against).model_path if against.is_dir() else against
    read_ply(path)
    return path


def merged_city(city: City, fill: bool = False, progress: SilentProgress | None = None) -> Merged:
    """Merge the blocks of a city into its model, and train that jointly, if the partition includes
    that; `fill` as for `merge`, `progress` : of the joint training.

    A tree of an earlier merge is removed, since it may be of other blocks. InputError if a block is
    missing; nothing is written then. Interrupted if the joint training was stopped.
    """
    merged = merge(city.folder, city.scene, fill)
    merged.check()
    run, scene = RunFolder(city.folder.path), city.scene
    try:
        merged = train_jointly(city, merged, progress)
    except OutOfDeviceMemory:
        log.warning("%s: there is no joint training, as the whole model does not fit the device", run.path)
        shutil.rmtree(city.folder.joint, ignore_errors=True)
    (run.path / TREE).unlink(missing_ok=True)
    _note_merge(city, merged)
    run.save_model(
        merged.gaussians,
        scene.offset,
        (f"merged of {len(merged.shares)} blocks", *placement_comments(scene.up, scene.georeference)),
    )
    return merged


def merge_city_tree(city: City, fill: bool = False) -> Merged:
    """Merge the blocks of a city into its tree, with one block at a time in memory.

    The file is replaced as a whole; a model and scores of an earlier merge stay. Arguments and
    errors as for `merged_city`.
    """
    folder, scene = city.folder, city.scene
    with writing_tree(folder.path / TREE, city.options.sh_degree, scene.offset) as writer:
        builder = TreeBuilder(writer)
        merged = merge(folder, scene, fill, builder.add)
        merged.check()
        builder.finish()
    if not RunFolder(folder.path).has_model:
        _note_merge(city, merged)
    return merged


def _note_merge(city: City, merged: Merged) -> None:
    """Make the city's folder a run, with the record of a merge and the learned exposures."""
    folder, scene, run = city.folder, city.scene, RunFolder(city.folder.path)
    coarse, trained = RunFolder(folder.coarse), RunFolder(folder.joint)
    joint = trained.has_model
    blocks = [RunFolder(block.run) for block in folder.blocks()]
    run.write_options(
        {
            **dataclasses.asdict(city.options),
            **trained_on(scene, city.options.init, city.device),
            "blocks": len(merged.shares),
        }
    )
    write_placement(run.path, scene, first_view=True)
    run.rewind(-1)
    run.log(
        {
            "event": "merge",
            **_cost([coarse, *blocks, *[trained] * joint]),
            "level": 1.0,
            "joint_steps": _cost([trained] * joint)["iteration"],
            **merged.record(),
        }
    )
    if responses := read_exposures((trained if joint else coarse).path):
        write_exposures(run.path, responses)


def evaluate_city(
    city: City, merged: Merged, against: Path | None = None
) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    """Score the merged model on the held-out views, measure its seams, and write the report.

    `against` : the PLY file of the reference for seams; None: that of the coarse model. Returns the
    result of `evaluate_run`, None without held-out views; and that of `find_seams`, by the training
    views where none are held out, None for a single block."""
    folder, options = city.folder, city.options
    run, record = Run.open(folder.path), merge_record(folder)
    spent = {key: record[key] for key in (*SPENT, "level", "gaussians")}
    scores = seams = None
    whole = city.pinhole
    scene = run.as_trained(whole)
    train, test = scene.split(options.test_every, options.test_offset)
    with timed(folder, "evaluation"):
        model = run.opened(city.device, scene, merged.gaussians)
        if test:
            scores = evaluate_run(run, city.device, False, scene, METRICS, model=model)
            run.folder.log(
                {
                    "event": "eval",
                    **spent,
                    **{key: value for key, value in scores.items() if key not in ("per_view", "pictures")},
                }
            )
        partition = folder.partition(scene)
        if len(merged.shares) > 1:
            reference = read_ply(against or RunFolder(folder.coarse).model_path, scene.offset)
            seams = find_seams(
                partition, scene, test or train, model, opened(city.device, reference.without_spheres(), scene, options)
            )
            run.folder.log(
                {
                    "event": "seams",
                    **spent,
                    "seam_db": seams["seam_db"],
                    "worst_seam_db": seams["worst_seam_db"],
                    "borders": seams["borders"],
                }
            )
    if seams:
        with replacing(folder.picture) as file:
            write_map(file, partition, whole, [share.gaussians for share in merged.shares], seams["borders"])
    write_report(run.folder, scores["pictures"] if scores else training_pictures(run, city.device), whole)
    return scores, seams


def merge_record(city: CityFolder) -> dict[str, Any]:
    """The latest record of a merge in the city's metrics."""
    return [record for record in RunFolder(city.path).records() if record["event"] == "merge"][-1]


def _cost(runs: Iterable[RunFolder]) -> dict[str, float]:
    """{iteration, train_seconds, wall_seconds}: sums over runs."""
    last = [record for run in runs for record in run.records()[-1:]]
    return {key: round(sum(record.get(key) or 0 for record in last), 3) for key in SPENT}


def train_jointly(city: City, merged: Merged, progress: SilentProgress | None = None) -> Merged:
    """Train a city as a whole in CITY/joint, or continue that.

    That of another merged model, or of another partition without one, is removed. Returns the
    blocks with the gaussians that now lie in their cells; `merged` if the partition has no joint
    training. Raises Interrupted, with the state saved, and DeviceError for a model too large."""
    folder, scene = city.folder, city.scene
    given, run = requested_of(folder, JOINT), RunFolder(folder.joint)
    if not given:
        shutil.rmtree(run.path, ignore_errors=True)
        return merged
    begin_with(city, merged.gaussians)
    if not run.has_model:
        together = joint_options(city, given, merged.count)
        parts: list[Part] = [Stage()]
        if together.exposure == "on":
            parts.append(PhotoResponses(read_exposures(folder.coarse)))
        with run.locked():
            training_of(
                dataclasses.replace(city.pinhole, notes=()), together, city.device, run, progress, parts=parts
            ).take()
    gaussians = run.load_model(scene.offset)
    owner = folder.partition(scene).owner(world_of(scene, gaussians.positions))
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=len(merged.shares))
    return dataclasses.replace(
        merged,
        gaussians=Gaussians({name: rows[order] for name, rows in gaussians.rows.items()}, gaussians.sh_degree),
        shares=tuple(dataclasses.replace(share, gaussians=int(counts[share.block])) for share in merged.shares),
    )


def begin_with(city: City, merged: Gaussians) -> None:
    """Write the points at which the joint training begins; remove that of other ones.

    They are half of the points of the merged gaussians and half of the dense points of the city,
    drawn at random; all of the former in a city without dense points.
    """
    folder, dense = city.folder, city.dense_gaussians(0)
    rng = np.random.default_rng([city.options.seed, 0])
    parts = [merged, dense] if dense else [merged]
    chosen = [rng.random(part.count) < 1 / len(parts) for part in parts]
    positions, constant = (
        np.concatenate([part.rows[name][which] for part, which in zip(parts, chosen)])
        for name in ("positions", "sh_constant")
    )
    new = folder.joint_start.with_suffix(".new.ply")
    write_ply(
        new, Gaussians.from_points(positions, to_bytes(255 * colours_of(constant)), sh_degree=0), city.scene.offset
    )
    if not (folder.joint_start.is_file() and filecmp.cmp(new, folder.joint_start, shallow=False)):
        shutil.rmtree(folder.joint, ignore_errors=True)
    os.replace(new, folder.joint_start)


def joint_options(city: City, given: Any, count: int) -> TrainOptions:
    """The options of the joint training, from those `given` in partition.json.

    A limit of gaussians is one of each block, so the merged model of `count` may have more; it does
    not grow then. The same views are held out as of one run."""
    joint = resolve(checked_values(str(city.folder.path / PARTITION), given), {"init": str(city.folder.joint_start)})
    most = joint.max_gaussians and max(joint.max_gaussians, count)
    return dataclasses.replace(
        joint, max_gaussians=most, test_every=city.options.test_every, test_offset=city.options.test_offset
    )
