"""Blocks to one model: each cropped to its cell, so that every gaussian is owned once.

A block trains a margin around its cell, and surroundings; both belong to its neighbours. What a
block lacks is listed, never passed over: `Merged.check` refuses a model with holes.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.city import CityFolder
from clsplat.io.lock import holder, is_locked
from clsplat.io.run import RunFolder
from clsplat.io.scenes import fingerprint
from clsplat.partition.input import world_of
from clsplat.partition.partition import Partition
from clsplat.scene import Scene

STARVED = 0.1  # gaussians a sparse point of its cell: a block that has fewer did not train well
WHOLE = ("merged", "coarse")  # states of a block whose cell is filled
TRAINS = "in training"  # by another process, at this moment
KEPT = (TRAINS, "refused")  # states of a block that is never filled; the last one's cure is said


@dataclass(frozen=True)
class Share:
    """What a block gave to the merged model.

    Attributes
    ----------
    block : its number.
    state : merged; coarse, the coarse model's gaussians in its place; or why not: missing,
        unfinished, in training, starved, refused.
    gaussians : that the merged model has of it.
    trained : gaussians of its own model, margin and surroundings included.
    views : how many it trained with.
    points : sparse points in its cell.
    note : more, for people.
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
    """Blocks as one model, whole or not.

    Attributes
    ----------
    gaussians : in the frame of the whole scene, block after block.
    shares : one for each block, in the same order.
    dropped : name of a view -> why no block took it.
    path : of the city.
    """

    gaussians: Gaussians
    shares: tuple[Share, ...]
    dropped: dict[str, str]
    path: Path

    def check(self) -> None:
        """Raise InputError where a cell is empty that should not be: one line that names all."""
        lacking = [share for share in self.shares if share.state not in WHOLE]
        if not lacking:
            return
        named = ", ".join(f"{share.block:03d} {share.state}" for share in lacking)
        cure = (f"see `clsplat block {self.path}/blocks/{lacking[0].block:03d}`, or fill them from "
                "the coarse model with --fill")
        for state in KEPT:
            cure = next((share.note for share in lacking if share.state == state), cure)
        raise InputError(f"{self.path}: {len(lacking)} of {len(self.shares)} blocks cannot be "
                         f"merged: {named}; {cure}")

    def record(self) -> dict[str, Any]:
        """A dict for JSON."""
        return {"blocks": [asdict(share) for share in self.shares], "dropped": self.dropped,
                "gaussians": self.gaussians.count}


def merge(city: CityFolder, scene: Scene, fill: bool = False) -> Merged:
    """Merge the finished blocks of a city; `Merged.check` says whether it is whole.

    One block at a time is read; what its cell holds is kept.

    Parameters
    ----------
    city : its folder.
    scene : the whole, as `read_scene` gave it.
    fill : take the coarse model's gaussians for cells that are missing, unfinished or starved; not
        of a block that another process trains at this moment.

    Raises
    ------
    InputError : another scene, a damaged partition, or block folders that are none of it.
    """
    if fingerprint(scene) != city.read()["fingerprint"]:
        raise InputError(f"{city.path}: is a city of another scene than {scene.path}; give the one "
                         "that it was begun with, or begin a new city")
    partition = city.partition(scene)
    _refuse_strangers(city, len(partition.regions))
    owner = partition.owner(world_of(scene, scene.points))
    points = np.bincount(owner[owner >= 0], minlength=len(partition.regions))
    pieces, shares = [], []
    for number, views in enumerate(partition.views):
        state, trained, piece, note = _block(city.block(number), number, partition, scene)
        if state == "merged" and piece.count < STARVED * points[number]:
            state, note = "starved", f"only {piece.count} gaussians in its cell"
        if state != "merged":
            piece = None
        pieces.append(piece)
        shares.append(Share(number, state, piece.count if piece else 0, trained, len(views),
                            int(points[number]), note))
    lacking = [s for s in shares if s.state not in ("merged", *KEPT)]
    if fill and lacking:
        coarse = RunFolder(city.coarse).load_model(scene.offset)
        for share in lacking:
            piece = pieces[share.block] = cropped(coarse, partition, share.block, scene.offset)
            shares[share.block] = Share(share.block, "coarse", piece.count, share.trained,
                                        share.views, share.points, f"{share.state}: {share.note}")
    dropped = {scene.views[view].name: why for view, why in partition.dropped.items()}
    return Merged(joined([piece for piece in pieces if piece]), tuple(shares), dropped, city.path)


def cropped(gaussians: Gaussians, partition: Partition, number: int,
            offset: NDArray[np.float64]) -> Gaussians:
    """The gaussians that block `number` owns, of those in a frame at `offset` float64[3], world."""
    kept = partition.owner(gaussians.positions.astype(np.float64) + offset) == number
    return Gaussians({f.name: gaussians.rows[f.name][kept] for f in LEARNED}, gaussians.sh_degree)


def joined(pieces: list[Gaussians]) -> Gaussians:
    """One model of several, in order, with the highest SH degree among them. The pieces' rows are
    given up one field after the other, so that both are not in memory whole."""
    degree = max((piece.sh_degree for piece in pieces), default=0)
    pieces = [piece.with_sh_degree(degree) for piece in pieces]
    return Gaussians({
        field.name: np.concatenate([piece.rows.pop(field.name) for piece in pieces]
                                   or [np.empty((0, *field.row_shape(degree)), np.float32)])
        for field in LEARNED}, degree)


def _block(folder, number, partition, scene):
    """(state, gaussians trained, those of its cell or None, note) of a BlockFolder."""
    if not folder.is_there:
        return "missing", 0, None, "it was never written"
    run = RunFolder(folder.run)
    if not run.has_model:
        if is_locked(folder.run):
            return TRAINS, 0, None, (f"{folder.path}: {holder(folder.run)} trains it; wait for it, "
                                     "or stop it")
        return "unfinished", 0, None, "its run has no model yet"
    try:
        folder.check()
        gaussians = run.load_model(scene.offset)
    except InputError as error:
        return "refused", 0, None, str(error)
    return "merged", gaussians.count, cropped(gaussians, partition, number, scene.offset), ""


def _refuse_strangers(city, count):
    """InputError where a folder is of no block, or claims to be of another than its name says."""
    for folder in city.blocks():
        number = folder.read()["number"]
        if folder.path != city.block(number).path or not 0 <= number < count:
            raise InputError(f"{folder.path}: says that it is block {number} of {count}; two "
                             "partitions are mixed here: remove those folders that are not yours")
