"""Merge blocks into one model: each is cropped to its cell, so that every gaussian is owned once.

A block trains a margin around its cell, and surroundings; both belong to its neighbours. Missing
blocks are listed, never ignored: `Merged.check` refuses a model with holes.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.lock import holder, is_locked
from clsplat.io.runs.city import BlockFolder, CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import fingerprint
from clsplat.partition.input import world_of
from clsplat.partition.region import Partition
from clsplat.scene import Scene

READ_TOGETHER = 4  # blocks, where all of them will be in memory
STARVED = 0.1  # gaussians for each sparse point of its cell; a block with fewer did not train well
FILLED = ("merged", "coarse")  # states of a block whose cell is filled
TRAINS = "in training"  # by another process, at this moment
MISSING = "missing"
NEVER_FILLED = (TRAINS, "refused")  # states of a block; the message gives the cure of the last one


@dataclass(frozen=True)
class Share:
    """The part of a block in the merged model.

    Attributes
    ----------
    block : its number.
    state : merged; coarse, if the coarse model's gaussians are in its place; or the reason why it
        has no part: missing, unfinished, in training, starved, refused.
    gaussians, trained : numbers of its gaussians in the merged model, and in its own, which has a
        margin and surroundings.
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
    elsewhere. shares : one for each block, in the same order.
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
        see = (f"see `clsplat block {self.path}/blocks/{lacking[0].block:03d}`"
               if lacking[0].state != MISSING else
               "run the `clsplat city` or `clsplat partition` that wrote the blocks again")
        cure = f"{see}, or fill them from the coarse model with --fill"
        for state in NEVER_FILLED:
            cure = next((share.note for share in lacking if share.state == state), cure)
        raise InputError(f"{self.path}: {len(lacking)} of {len(self.shares)} blocks cannot be "
                         f"merged: {named}; {cure}")

    @property
    def count(self) -> int:
        """How many gaussians the model has."""
        return sum(share.gaussians for share in self.shares)

    def record(self) -> dict[str, Any]:
        """A dict for JSON."""
        return {"blocks": [asdict(share) for share in self.shares], "dropped": self.dropped,
                "gaussians": self.count}


def merge(city: CityFolder, scene: Scene, fill: bool = False,
          keep: Callable[[Gaussians], object] | None = None) -> Merged:
    """Merge the finished blocks of a city; `Merged.check` says whether the model has holes.

    Parameters
    ----------
    city, scene : its folder; the whole, as `read_scene` returns it.
    fill : take the coarse model's gaussians for blocks that are missing, unfinished or starved, but
        not for a block that another process trains at this moment.
    keep : called with the gaussians of each block, one at a time in memory; None: they are joined.

    Raises
    ------
    InputError : another scene, a damaged partition, or block folders of another partition.
    """
    if fingerprint(scene) != city.read()["fingerprint"]:
        raise InputError(f"{city.path}: is a city of another scene than {scene.path}; give the one "
                         "that it was begun with, or begin a new city")
    partition = city.partition(scene)
    _check_numbers(city, len(partition.regions))
    owner = partition.owner(world_of(scene, scene.points))
    points = np.bincount(owner[owner >= 0], minlength=len(partition.regions))
    pieces: list[Gaussians] = []
    shares, coarse = [], None
    blocks = ((city.block(number), number, partition, scene)
              for number in range(len(partition.regions)))
    found = starmap(_block, blocks) if keep else called_ahead(
        _block, blocks, READ_TOGETHER, READ_TOGETHER)
    keep = keep or pieces.append
    for number, views in enumerate(partition.views):
        state, trained, piece, note = next(found)
        if piece and piece.count < STARVED * points[number]:
            state, note = "starved", f"only {piece.count} gaussians in its cell"
            piece = None
        if fill and state not in ("merged", *NEVER_FILLED):
            coarse = coarse or RunFolder(city.coarse).load_model(scene.offset)
            piece = cropped(coarse, partition, number, scene.offset)
            state, note = "coarse", f"{state}: {note}"
        shares.append(Share(number, state, piece.count if piece else 0, trained, len(views),
                            int(points[number]), note))
        if piece:
            keep(piece)
        del piece  # else it is in memory beside the next one
    dropped = {scene.views[view].name: reason for view, reason in partition.dropped.items()}
    return Merged(joined(pieces), tuple(shares), dropped, city.path)


def cropped(gaussians: Gaussians, partition: Partition, number: int,
            offset: NDArray[np.float64]) -> Gaussians:
    """The gaussians that block `number` owns; world = their coordinates + `offset` [3]."""
    kept = partition.owner(gaussians.positions.astype(np.float64) + offset) == number
    return Gaussians({f.name: gaussians.rows[f.name][kept] for f in LEARNED}, gaussians.sh_degree)


def joined(pieces: list[Gaussians]) -> Gaussians:
    """One model of several, in order, with the highest SH degree among them.

    The pieces' rows are removed one field after the other, to save memory.
    """
    degree = max((piece.sh_degree for piece in pieces), default=0)
    pieces = [piece.with_sh_degree(degree) for piece in pieces]
    return Gaussians({
        field.name: np.concatenate([piece.rows.pop(field.name) for piece in pieces]
                                   or [np.empty((0, *field.row_shape(degree)), np.float32)])
        for field in LEARNED}, degree)


def _block(folder: BlockFolder, number: int, partition: Partition, scene: Scene
           ) -> tuple[str, int, Gaussians | None, str]:
    """The state of a block, its number of trained gaussians, those of its cell, and a note."""
    if not folder.is_there:
        return MISSING, 0, None, "it was never written"
    run = RunFolder(folder.run)
    if not run.has_model:
        if is_locked(folder.run):
            return TRAINS, 0, None, (f"{folder.path}: {holder(folder.run)} trains it; wait for it, "
                                     "or stop it")
        return "unfinished", 0, None, "its run has no model yet"
    try:
        folder.check()
        folder.check_own(run.model_path)
        gaussians = run.load_model(scene.offset)
    except InputError as error:
        return "refused", 0, None, str(error)
    piece = cropped(gaussians, partition, number, scene.offset)
    return "merged", gaussians.count, piece, ""


def _check_numbers(city: CityFolder, count: int) -> None:
    """InputError where a folder's number is not that of its name, or not one of `count` blocks."""
    for folder in city.blocks():
        number = folder.read()["number"]
        if folder.path != city.block(number).path or not 0 <= number < count:
            raise InputError(f"{folder.path}: says that it is block {number} of {count}; two "
                             "partitions are mixed here: remove the folders of the other one")
