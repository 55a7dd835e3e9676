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
from clsplat.training.checkpoint import Arrays, Saved, gaussians_of
from clsplat.training.recorder import LOG_EVERY

STATISTICS = ("statistics.grad_norm_sum", "statistics.seen_count")
SCALES = "row.log_scales"
PLACED = ("row.positions", SCALES, "row.quaternions")  # where a gaussian is, and how large
# arrays of a part -> power of a length; gradients by positions have one over a length
LENGTHS = {"row.max_offsets": 1, "m.positions": -1, "v.positions": -2}
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


def write_part(block: BlockFolder, scene: Scene, number: int, run: RunFolder) -> None:
    """Write what a block owns, with Adam's moments, unless that was done before.

    Parameters
    ----------
    block : its folder.
    scene : in that folder, as it was read.
    number : of the exchange, from 1.
    run : of the block, with a checkpoint at the exchange.
    """
    path = block.part(number)
    if path.exists():
        return
    scene = scene.normalised()
    assert scene.region is not None
    arrays, _ = run.load_checkpoint(_is_by_gaussian)
    owned = scene.region.owns(scene.offset + scene.unit * arrays["row.positions"].astype(float))
    with replacing(path) as file:
        write_npz(file, {**{name: values[owned] for name, values in arrays.items()},
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
             options: TrainOptions, number: int, run: RunFolder) -> Saved:
    """Replace a block's margin and surroundings by the parts of other blocks.

    Returns the checkpoint from which the block goes on; that of its run stays as it is. What its
    views show as layers is written into its run. Gaussians of the margin bring the moments of their
    owner.

    Parameters
    ----------
    block : no part of the exchange lacks.
    scene : in its folder, as it was read.
    others : its `other_blocks`.
    options : of its training.
    number : of the exchange, from 1.
    run : of the block, with a checkpoint at the exchange; its rows are in the block's part.
    """
    record = block.read()
    arrays, state = run.load_checkpoint(lambda name: not _is_by_gaussian(name))
    scene = scene.reduced(options.downscale, options.max_resolution).normalised()
    region = scene.region
    assert region is not None
    own, degree, _ = _read_part(block.part(number), record)

    def taken_from(other: BlockFolder) -> tuple[Arrays, Arrays]:
        """What the block holds of another one, and what it draws as layers."""
        part, _, frame = _read_part(other.part(number), record)
        placed = _in_frame_of(scene, {name: part[name] for name in PLACED}, frame)
        start = block_start(Gaussians({name.removeprefix("row."): values
                                       for name, values in placed.items()}, degree),
                            scene, region, scene.views, lambda _: LAYERS in record)
        held = start.gaussians.count
        taken = _in_frame_of(scene, {name: values[start.indices[:held]]
                                     for name, values in part.items()}, frame)
        around = _in_frame_of(scene, {name: values[start.indices[held:]]
                                      for name, values in part.items()
                                      if name.startswith("row.")}, frame)
        for rows, gaussians in ((taken, start.gaussians), (around, start.around)):
            if gaussians:  # which may be thinned
                rows[SCALES] = gaussians.log_scales.astype(part[SCALES].dtype)
        return taken, around

    with ThreadPoolExecutor(PARTS_TOGETHER) as threads:
        found = list(threads.map(taken_from, others))
    if LAYERS in record:
        rows = {field.name: np.concatenate([around[f"row.{field.name}"] for _, around in found]
                                           or [own[f"row.{field.name}"][:0]]) for field in LEARNED}
        write_ply(block.around, Gaussians(rows, degree).scaled(scene.unit), scene.offset)
    new = {name: np.concatenate([values, *(taken[name] for taken, _ in found)])
           for name, values in own.items()}
    trains = trainable(scene, new["row.positions"], new[SCALES])
    return {**arrays, **new, "statistics.frozen": (~trains).astype(np.uint32),
            "adam.last_step": np.full(len(trains), state["iteration"], np.uint32)}, state


def _read_part(path: Path, record: dict[str, Any]) -> tuple[Arrays, int, dict[str, Any]]:
    """The arrays of a part, the degree of its harmonics and its state; InputError if it is damaged
    or of another city."""
    complaint, cure = "damaged", f"remove {path.parent}, and train that block again"
    arrays = read_npz(path, complaint, cure)
    try:
        state = object_of(arrays.pop(STATE).tobytes())
        degree = int(np.sqrt(arrays["row.sh_rest"].shape[1] + 1)) - 1
        gaussians_of(arrays, degree)
        if not (state["unit"] > 0 and np.shape(state["offset"]) == (3,)):
            raise ValueError("its frame")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {complaint} ({error}); {cure}") from None
    if state.get(CITY) != record[CITY]:
        raise InputError(f"{path}: of another city; {cure}")
    return arrays, degree, state


def _in_frame_of(scene: Scene, part: Arrays, frame: dict[str, Any]) -> Arrays:
    """Rows of a part, and their moments, in the frame of another block.

    Parameters
    ----------
    scene : of that block.
    part : some or all arrays of a part.
    frame : the state of the part.
    """
    factor = frame["unit"] / scene.unit
    moved = dict(part)
    for name in ("row.positions", "row.anchors"):
        if name in part:
            world = np.asarray(frame["offset"]) + frame["unit"] * part[name].astype(float)
            moved[name] = ((world - scene.offset) / scene.unit).astype(part[name].dtype)
    for name, power in LENGTHS.items():
        if name in part:
            moved[name] = (part[name] * factor**power).astype(part[name].dtype)
    if SCALES in part:
        moved[SCALES] = (part[SCALES] + np.log(factor)).astype(part[SCALES].dtype)
    return moved


def _is_by_gaussian(name: str) -> bool:
    """Whether an array of a checkpoint that a part has too has a row a gaussian."""
    return name.partition(".")[0] in ("row", "m", "v") or name in STATISTICS
