"""Blocks exchange gaussians at a few moments of their training: both sides of a border then agree.

A block trains a margin that other blocks own, and draws what lies beyond as the coarse run left it;
after merging, its own gaussians stand beside others than those that they were trained with. At an
exchange, every block writes what it owns into a file, its part. Then each puts the parts of the
others in place of its margin and its surroundings, and goes on. Blocks still take the same number
of steps. This is the alternating method of Schwarz (1870) for domains that overlap; DOGS (Chen and
Lee, 2024) reaches the same aim with averages of what blocks share.

What a block goes on from follows from parts alone, and a part is written once: so a block that is
killed during an exchange repeats it, and ends in the same bytes.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.city import LAYERS, BlockFolder, CityFolder
from clsplat.io.npz import read_npz, state_array, write_npz
from clsplat.io.ply import write_ply
from clsplat.io.records import object_of
from clsplat.io.run import STATE, RunFolder
from clsplat.options import TrainOptions
from clsplat.partition.blocks import block_start, trainable
from clsplat.scene import Scene
from clsplat.training.checkpoint import Arrays, gaussians_of
from clsplat.training.recorder import LOG_EVERY

STATISTICS = ("statistics.grad_norm_sum", "statistics.seen_count")
PARTS_TOGETHER = 4  # that are read at the same time, so that not all of them are in memory
CITY = "city"  # key of block.json, and of a part: the fingerprint of the whole scene


def exchange_steps(steps: int, count: int) -> list[int]:
    """After how many of a block's steps it exchanges gaussians: evenly over their second half.

    These are multiples of LOG_EVERY, when Adam has brought all rows up to the last step.

    Parameters
    ----------
    steps : of the block.
    count : number of exchanges, at most `most_exchanges(steps)`.
    """
    return [LOG_EVERY * round(steps * (1 + number / count) / 2 / LOG_EVERY)
            for number in range(count)]


def most_exchanges(steps: int) -> int:
    """The largest number of exchanges for which a block of so many steps has different moments."""
    return steps // (2 * LOG_EVERY)


def write_part(block: BlockFolder, scene: Scene, number: int) -> None:
    """Write what a block owns, with Adam's moments, unless that was done before.

    Parameters
    ----------
    block : its run has a checkpoint at the exchange.
    scene : in its folder, as it was read.
    number : of the exchange, from 1.
    """
    path = block.part(number)
    if path.exists():
        return
    arrays, _ = RunFolder(block.run).load_checkpoint()
    scene = scene.normalised()
    assert scene.region is not None
    owned = scene.region.owns(scene.offset + scene.unit * arrays["row.positions"].astype(float))
    with replacing(path) as file:
        write_npz(file, {**{name: values[owned] for name, values in arrays.items()
                            if _is_by_gaussian(name)},
                         STATE: state_array({"unit": scene.unit, "offset": scene.offset.tolist(),
                                             CITY: block.read()[CITY]})})


def other_blocks(block: BlockFolder) -> list[BlockFolder]:
    """The blocks with which a block exchanges gaussians.

    Raises
    ------
    InputError : the block is not in the folder of its city.
    """
    city = CityFolder(block.path.absolute().parents[1])
    if not city.has_record:
        raise InputError(f"{block.path}: exchanges gaussians with the other blocks of its city; "
                         "train it in the city's folder, or with --alone")
    return [city.block(number) for number in block.others]


def lacking_blocks(others: Iterable[BlockFolder], number: int) -> list[str]:
    """Names of the blocks without whose parts a block cannot do an exchange.

    Parameters
    ----------
    others : the `other_blocks` of the block.
    number : of the exchange, from 1.

    Raises
    ------
    InputError : another block is of another partition.
    """
    for other in others:
        if other.is_there:
            other.check()
    return [other.path.name for other in others if not other.part(number).is_file()]


def exchange(block: BlockFolder, scene: Scene, others: Iterable[BlockFolder],
             options: TrainOptions, number: int) -> None:
    """Replace a block's margin and surroundings by the parts of other blocks.

    Changes the checkpoint of its run, and what its views show as layers. Gaussians of the margin
    bring the moments of their owner.

    Parameters
    ----------
    block : its run has a checkpoint at the exchange, and no part lacks.
    scene : in its folder, as it was read.
    others : its `other_blocks`.
    options : of its training.
    number : of the exchange, from 1.
    """
    run, record = RunFolder(block.run), block.read()
    arrays, state = run.load_checkpoint()
    scene = scene.reduced(options.downscale, options.max_resolution).normalised()
    region = scene.region
    assert region is not None
    own = _read_part(block.part(number), record)[0]
    degree = gaussians_of(own, _degree(own)).sh_degree

    def taken_from(other: BlockFolder) -> tuple[Arrays, Gaussians | None]:
        """What the block holds of another one, and what it draws as layers."""
        part = _in_frame_of(scene, *_read_part(other.part(number), record))
        start = block_start(gaussians_of(part, degree), scene, region, scene.views,
                            lambda _: LAYERS in record)
        kept = start.indices[:start.gaussians.count]
        taken = {name: values[kept] for name, values in part.items()}
        taken["row.log_scales"] = start.gaussians.log_scales.astype(part["row.log_scales"].dtype)
        return taken, start.around

    with ThreadPoolExecutor(PARTS_TOGETHER) as threads:
        found = list(threads.map(taken_from, others))
    parts = [own, *(taken for taken, _ in found)]
    if LAYERS in record:
        around = [each for _, each in found if each is not None]
        rows = {field.name: np.concatenate([each.rows[field.name] for each in around]
                                           or [own[f"row.{field.name}"][:0]]) for field in LEARNED}
        write_ply(block.around, Gaussians(rows, degree).scaled(scene.unit), scene.offset)
    new = {name: np.concatenate([part[name] for part in parts]).astype(values.dtype)
           for name, values in own.items()}
    trains = trainable(scene, new["row.positions"], new["row.log_scales"])
    run.save_checkpoint({
        **arrays, **new, "statistics.frozen": (~trains).astype(np.uint32),
        "adam.last_step": np.full(len(trains), state["iteration"], np.uint32)}, state)


def _read_part(path: Path, record: dict[str, Any]) -> tuple[Arrays, dict[str, Any]]:
    """The arrays of a part and its state; InputError if it is damaged or of another city."""
    complaint, cure = "damaged", f"remove {path.parent}, and train that block again"
    arrays = read_npz(path, complaint, cure)
    try:
        state = object_of(arrays.pop(STATE).tobytes())
        gaussians_of(arrays, _degree(arrays))
        if not (state["unit"] > 0 and np.shape(state["offset"]) == (3,)):
            raise ValueError("its frame")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {complaint} ({error}); {cure}") from None
    if state.get(CITY) != record[CITY]:
        raise InputError(f"{path}: of another city; {cure}")
    return arrays, state


def _in_frame_of(scene: Scene, part: Arrays, state: dict[str, Any]) -> Arrays:
    """A part in the frame of another block, with the moments that its gradients have there."""
    factor = state["unit"] / scene.unit
    moved = dict(part)
    for name in ("positions", "anchors"):
        if f"row.{name}" in part:
            world = np.asarray(state["offset"]) + state["unit"] * part[f"row.{name}"].astype(float)
            moved[f"row.{name}"] = (world - scene.offset) / scene.unit
    moved["row.log_scales"] = part["row.log_scales"] + np.log(factor)
    if "row.max_offsets" in part:
        moved["row.max_offsets"] = part["row.max_offsets"] * factor
    moved["m.positions"] = part["m.positions"] / factor
    moved["v.positions"] = part["v.positions"] / factor**2
    return {name: values.astype(part[name].dtype) for name, values in moved.items()}


def _is_by_gaussian(name: str) -> bool:
    """Whether an array of a checkpoint that a part has too has a row a gaussian."""
    return name.partition(".")[0] in ("row", "m", "v") or name in STATISTICS


def _degree(arrays: Arrays) -> int:
    """The degree of the harmonics in the arrays of a part."""
    return int(np.sqrt(arrays["row.sh_rest"].shape[1] + 1)) - 1
