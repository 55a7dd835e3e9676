"""Blocks exchange gaussians at a few moments of their training: both sides of a border then agree.

A block trains a margin that other blocks own, and draws what lies beyond as the coarse run left it;
after merging, its own gaussians stand beside others than those that they were trained with. At an
exchange, every block writes what it owns into a file. Then each puts what others own in place of
its margin and its surroundings, and goes on. Blocks still take the same number of steps. This is
the alternating method of Schwarz (1870) for domains that overlap; DOGS (Chen and Lee, 2024) reaches
the same aim with averages of what blocks share.

What a block goes on from follows from these files alone, and each is written once: so a block that
is killed during an exchange repeats it, and ends in the same bytes.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.cities.scene import BlockScene
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.fields import reading
from clsplat.io.models.ply import START
from clsplat.io.npz import read_npz, state_array, write_npz
from clsplat.io.records import object_of
from clsplat.io.runs.city import BlockFolder, CityFolder
from clsplat.io.runs.run import STATE, RunFolder
from clsplat.options import SceneOptions
from clsplat.partition.blocks import block_start, trainable
from clsplat.scene import Scene
from clsplat.training.checkpoint import Arrays, gaussians_of
from clsplat.training.parts.average import Average
from clsplat.training.recorder import LOG_EVERY

STATISTICS = ("statistics.grad_norm_sum", "statistics.seen_count")
SCALES = "row.log_scales"
PLACES = ("row.positions", "row.anchors")
# arrays of what is owned -> power of a length; gradients by positions have one over a length
LENGTHS = {"row.max_offsets": 1, "m.positions": -1, "v.positions": -2}
READ_TOGETHER = 2  # files, so that not all of them are in memory
CITY = "city"  # key of block.json, and of these files: the fingerprint of the whole scene


def exchange_steps(steps: int, count: int) -> list[int]:
    """After how many of a block's steps it exchanges gaussians: evenly over their second half.

    These are multiples of LOG_EVERY, when Adam has brought all rows up to the last step; `count` is
    at most `most_exchanges(steps)`.
    """
    return [LOG_EVERY * round(steps * (1 + number / count) / 2 / LOG_EVERY)
            for number in range(count)]


def most_exchanges(steps: int) -> int:
    """The largest number of exchanges for which a block of so many steps has different moments."""
    return steps // (2 * LOG_EVERY)


def write_owned(block: BlockFolder, own: BlockScene, number: int) -> None:
    """Write what a block owns, with Adam's moments, from the checkpoint of its run, unless that was
    done before; `own` : the block as it was read, `number` : of the exchange, from 1."""
    path = block.exchanged(number)
    if path.exists():
        return
    scene = own.scene.normalised()
    arrays, _ = RunFolder(block.run).load_checkpoint(_is_by_gaussian)
    owned = own.region.owns(scene.offset + scene.unit * arrays["row.positions"].astype(float))
    with replacing(path) as file:
        write_npz(file, {**{name: values[owned] for name, values in arrays.items()},
                         STATE: state_array({"unit": scene.unit, "offset": scene.offset.tolist(),
                                             CITY: block.read()[CITY], START: block.start()})})


def other_blocks(block: BlockFolder) -> list[BlockFolder]:
    """The blocks with which a block exchanges gaussians; InputError outside its city's folder."""
    city = CityFolder(block.path.absolute().parents[1])
    if not city.has_record:
        raise InputError(f"{block.path}: exchanges gaussians with the other blocks of its city; "
                         "train it in the city's folder, or with --alone")
    return [city.block(number) for number in block.others]


def lacking_blocks(others: Iterable[BlockFolder], number: int) -> list[str]:
    """Names of those `other_blocks` without whose files a block cannot do the exchange `number`;
    InputError if one is of another partition."""
    for other in others:
        if other.is_there:
            other.check()
    return [other.path.name for other in others if not other.exchanged(number).is_file()]


def exchange(block: BlockFolder, read: BlockScene, others: Iterable[BlockFolder],
             options: SceneOptions, number: int) -> None:
    """Replace a block's margin and surroundings, in the checkpoint of its run, by what other blocks
    own. Gaussians of the margin bring the moments of their owner.

    Parameters
    ----------
    block, read, others : its folder, the block as it was read, and its `other_blocks`.
    options, number : of its training; of the exchange, from 1.
    """
    run, record = RunFolder(block.run), block.read()
    degree = record["options"]["sh_degree"]
    arrays, state = run.load_checkpoint(lambda name: not _is_by_gaussian(name))
    scene = read.scene.reduced(options.downscale, options.max_resolution).normalised()
    region = read.region

    def taken_from(other: BlockFolder) -> Arrays:
        """What the block holds of another one."""
        owned = _in_frame_of(scene, *_owned(other, number, record))
        start = block_start(gaussians_of(owned, degree), scene, region, scene.views)
        taken = {name: values[start.indices] for name, values in owned.items()}
        # which may be thinned
        return {**taken, SCALES: start.gaussians.log_scales.astype(owned[SCALES].dtype)}

    with ThreadPoolExecutor(READ_TOGETHER) as threads:
        found = list(threads.map(taken_from, others))
    owned, _ = _owned(block, number, record)
    new = {name: np.concatenate([values, *(taken.pop(name) for taken in found)])
           for name, values in owned.items()}
    trains = trainable(scene, region, new["row.positions"], new[SCALES])
    kept = {name: values for name, values in arrays.items()
            if not name.startswith(f"{Average.name}.")}  # of rows that are others now
    run.save_checkpoint({
        **kept, **new, "frozen.rows": (~trains).astype(np.uint32),
        "adam.last_step": np.full(len(trains), state["iteration"], np.uint32)}, state)


def _owned(block: BlockFolder, number: int, record: dict[str, Any]
           ) -> tuple[Arrays, dict[str, Any]]:
    """What a block owned at an exchange, as arrays of a checkpoint, and the unit and the offset of
    its frame; InputError for a file that is damaged, or of another city or block. `record` : of the
    block that reads it."""
    path = block.exchanged(number)
    cure = f"remove {path.parent}, and train that block again"
    with reading(path, "what a block owned at an exchange", cure):
        arrays = read_npz(path)
        frame = object_of(arrays.pop(STATE).tobytes())
        gaussians_of(arrays, record["options"]["sh_degree"])
        if not (frame["unit"] > 0 and np.shape(frame["offset"]) == (3,)):
            raise ValueError("its frame is none")
    if (frame.get(CITY), frame.get(START)) != (record[CITY], block.start()):
        raise InputError(f"{path}: of another city, block or partition than {block.path}; {cure}")
    return arrays, frame


def _in_frame_of(scene: Scene, owned: Arrays, frame: dict[str, Any]) -> Arrays:
    """What `_owned` returns in the frame of another block's scene."""
    factor, offset = frame["unit"] / scene.unit, np.asarray(frame["offset"])

    def moved(name: str, values: NDArray[Any]) -> Any:
        if name in PLACES:
            return (offset + frame["unit"] * values.astype(float) - scene.offset) / scene.unit
        if name == SCALES:
            return values + np.log(factor)
        return values * factor**LENGTHS[name] if name in LENGTHS else values

    return {name: moved(name, values).astype(values.dtype) for name, values in owned.items()}


def _is_by_gaussian(name: str) -> bool:
    """Whether an array of a checkpoint, which exchanges contain too, has a row a gaussian."""
    return name.partition(".")[0] in ("row", "m", "v") or name in STATISTICS
