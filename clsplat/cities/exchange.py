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

from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.cities.scene import BlockScene
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.fields import reading
from clsplat.io.models.ply import START, read_ply
from clsplat.io.npz import read_npz, state_array, write_npz
from clsplat.io.records import object_of
from clsplat.io.runs.city import BlockFolder, CityFolder
from clsplat.io.runs.run import STATE, RunFolder
from clsplat.options import SceneOptions
from clsplat.partition.blocks import block_start, trainable
from clsplat.partition.region import world_of
from clsplat.scene import Scene
from clsplat.training.checkpoint import Arrays, Saved, check_arrays
from clsplat.training.parts.average import Average
from clsplat.training.recorder import LOG_EVERY

MOMENTS = "m", "v"
REPLACED = "frozen.rows", "adam.last_step"  # arrays that are new after an exchange
TRAINING = "training"  # key of these files: the state in a checkpoint
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


class BlockRun(RunFolder):
    """The run of a block, whose checkpoint at an exchange is the file of what the block owns.

    Nothing else of its gaussians is needed then, as it goes on beside those of other blocks.

    Parameters
    ----------
    block, own : its folder, and the block as it was read.
    number : of the exchange, from 1, to which it is trained; 0: to the end.
    begins : what it goes on from, as `exchange` returns it; None: its checkpoint.
    """

    def __init__(self, block: BlockFolder, own: BlockScene, number: int = 0,
                 begins: Saved | None = None) -> None:
        super().__init__(block.run)
        self._block, self._own, self._number, self._begins = block, own, number, begins

    @property
    def has_checkpoint(self) -> bool:
        """As in `RunFolder`."""
        return self._begins is not None or super().has_checkpoint

    def load_checkpoint(self, wanted: Callable[[str], bool] = lambda name: True) -> Saved:
        """As in `RunFolder`; what it begins with is handed over once, as it takes much memory."""
        begins, self._begins = self._begins, None
        return begins or super().load_checkpoint(wanted)

    def save_checkpoint(self, arrays: Arrays, state: dict[str, Any]) -> None:
        """As in `RunFolder`, but for the checkpoint at the exchange."""
        if not self._number or state["iteration"] < self._block.exchanges[self._number - 1]:
            super().save_checkpoint(arrays, state)
            return
        scene, record = self._own.scene.normalised(), self._block.read()
        owned = np.flatnonzero(self._own.region.owns(world_of(scene, arrays["row.positions"])))
        kept = {name: values[owned] if _is_by_gaussian(name) else values
                for name, values in arrays.items()
                if name not in REPLACED and not name.startswith(f"{Average.name}.")}
        with replacing(self._block.exchanged(self._number)) as file:
            write_npz(file, {**kept, STATE: state_array({
                TRAINING: state, "unit": scene.unit, "offset": scene.offset.tolist(),
                CITY: record[CITY], START: self._block.start()})})
        self.remove_checkpoint()


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


def exchange(block: BlockFolder, own: BlockScene, others: Iterable[BlockFolder],
             options: SceneOptions, number: int) -> Saved:
    """What a block goes on from: what it owns, and in place of its margin and its surroundings what
    other blocks own. Gaussians of the margin bring the moments of their owner.

    Parameters
    ----------
    block, own : its folder, and the block as it was read.
    others : its `other_blocks`; without them the margin and the surroundings are again as the block
        began with them.
    options, number : of its training; of the exchange, from 1.
    """
    record = block.read()
    degree = record["options"]["sh_degree"]
    scene = own.scene.reduced(options.downscale, options.max_resolution).normalised()

    def taken_from(other: BlockFolder) -> Arrays:
        """What the block holds of another one."""
        rows, frame = _owned(other, number, record, ["row"])
        rows = _in_frame_of(scene, rows, frame)
        start = block_start(Gaussians({name.removeprefix("row."): values
                                       for name, values in rows.items() if name not in STATISTICS},
                                      degree), scene, own.region, scene.views)
        taken = {name: values[start.indices] for name, values in rows.items()}
        # which may be thinned
        taken[SCALES] = start.gaussians.log_scales.astype(rows[SCALES].dtype)
        if not start.own + start.margin:  # none is trained
            return taken
        moments, _ = _owned(other, number, record, MOMENTS)
        return {**taken, **_in_frame_of(scene, {name: values[start.indices] for name, values
                                                in moments.items()}, frame)}

    def taken_from_start() -> Arrays:
        """The margin and the surroundings with which the block began."""
        gaussians = read_ply(block.initial, scene.offset).scaled(1 / scene.unit)
        gaussians = gaussians.with_sh_degree(degree)
        beyond = ~own.region.owns(world_of(scene, gaussians.positions))
        return {name: gaussians.rows[name.removeprefix("row.")][beyond].astype(values.dtype)
                for name, values in owned.items() if name.startswith("row.")}

    def array(taken: Arrays, name: str, own_values: NDArray[Any]) -> NDArray[Any]:
        """An array of what is taken; 0 where it has none of this name."""
        shape = len(taken[SCALES]), *own_values.shape[1:]
        return taken[name] if name in taken else np.zeros(shape, own_values.dtype)

    arrays, frame = _owned(block, number, record)
    owned = {name: values for name, values in arrays.items() if _is_by_gaussian(name)}
    with ThreadPoolExecutor(READ_TOGETHER) as threads:
        found = list(threads.map(taken_from, others)) or [taken_from_start()]
    new = {name: np.concatenate([values, *(array(taken, name, values) for taken in found)])
           for name, values in owned.items()}
    trains = trainable(scene, own.region, new["row.positions"], new[SCALES])
    state = frame[TRAINING]
    return {**arrays, **new, "frozen.rows": (~trains).astype(np.uint32),
            "adam.last_step": np.full(len(trains), state["iteration"], np.uint32)}, state


def _owned(block: BlockFolder, number: int, record: dict[str, Any], kinds: Collection[str] = ()
           ) -> tuple[Arrays, dict[str, Any]]:
    """What a block owned at an exchange, as arrays of a checkpoint, and the unit and the offset of
    its frame with the state of its training; InputError for a file that is damaged, or of another
    city or block.

    `record` : of the block that reads it; `kinds` : of the arrays that it reads, besides
    statistics; none: all that there are."""
    path = block.exchanged(number)
    cure = f"remove {path.parent}, and train that block again"
    with reading(path, "what a block owned at an exchange", cure):
        arrays = read_npz(path, lambda name: not kinds or name in (STATE, *STATISTICS)
                          or name.partition(".")[0] in kinds)
        frame = object_of(arrays.pop(STATE).tobytes())
        check_arrays(arrays, record["options"]["sh_degree"], kinds or ("row", *MOMENTS))
        if not (frame["unit"] > 0 and np.shape(frame["offset"]) == (3,)
                and frame[TRAINING]["iteration"] > 0):
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

    return {name: moved(name, values).astype(values.dtype, copy=False)
            for name, values in owned.items()}


def _is_by_gaussian(name: str) -> bool:
    """Whether an array of a checkpoint, which exchanges contain too, has a row a gaussian."""
    return name.partition(".")[0] in ("row", "m", "v") or name in STATISTICS
