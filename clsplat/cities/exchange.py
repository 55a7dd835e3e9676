"""Blocks exchange gaussians at a few moments of their training: both sides of a border then agree.

A block trains a margin that other blocks own, and draws what lies beyond as the coarse run left it;
after merging, its own gaussians stand beside others than those that they were trained with. At an
exchange, every block writes what it owns into a file. Then each puts what others own in place of
its margin and its surroundings, and goes on. Blocks still take the same number of steps. This is
the alternating method of Schwarz (1870) for domains that overlap; DOGS (Chen and Lee, 2024) reaches
the same aim with averages of what blocks share.

What a block goes on from follows from these files alone, and each is written once: so a block that
is killed during an exchange repeats it, and ends in the same bytes. They are large, so those of an
exchange are removed once all blocks have come to the next one.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.cities.choose import choose_gaussians
from clsplat.cities.scene import BlockScene
from clsplat.device import Device
from clsplat.edit.select import selected
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.fields import reading
from clsplat.io.models.ply import START, read_ply
from clsplat.io.npz import read_npz, read_rows, state_array, state_of, write_npz
from clsplat.io.records import with_format
from clsplat.io.runs.city import BlockFolder, CityFolder
from clsplat.io.runs.run import STATE, RunFolder
from clsplat.options import SceneOptions
from clsplat.partition.region import Region, in_parts, world_of
from clsplat.scene import Scene
from clsplat.training.checkpoint import BY_GAUSSIAN, Arrays, Saved, check_arrays
from clsplat.training.loop import Training
from clsplat.training.parts.average import Average
from clsplat.training.recorder import LOG_EVERY

REPLACED = "frozen.rows", "adam.last_step"  # arrays that are new at an exchange
TRAINING = "training"  # key of these files: the state in a checkpoint
STATISTICS = ("statistics.grad_norm_sum", "statistics.seen_count")
SCALES = "row.log_scales"
POSITIONS = "row.positions"
PLACES = (POSITIONS, "row.anchors")
# arrays of what is owned -> power of a length; gradients by positions have one over a length
LENGTHS = {"row.max_offsets": 1, "m.positions": -1, "v.positions": -2}
READ_TOGETHER = 4  # files, so that not all of them are in memory
CITY = "city"  # key of block.json, and of these files: the fingerprint of the whole scene


def exchange_steps(steps: int, count: int) -> list[int]:
    """After how many of a block's steps it exchanges gaussians: evenly over their second half.

    These are multiples of LOG_EVERY, when Adam has brought all rows up to the last step; `count` is
    at most `most_exchanges(steps)`.
    """
    return [LOG_EVERY * round(steps * (1 + number / count) / 2 / LOG_EVERY) for number in range(count)]


def most_exchanges(steps: int) -> int:
    """The largest number of exchanges for which a block of so many steps has different moments."""
    return steps // (2 * LOG_EVERY)


class BlockRun(RunFolder):
    """The run of a block, whose checkpoint at an exchange is the file of what the block owns.

    Nothing else of its gaussians is needed then, as it goes on beside those of other blocks. Its
    model has what the block owns and its margin.

    Parameters
    ----------
    block, own : its folder, and the block as it was read.
    begins : what it goes on from, as of `owned_at`; None: its checkpoint.

    Attributes
    ----------
    block, own : as given.
    number : of the exchange, from 1, to which it is trained; 0: to the end.
    owned : int[K], the rows that the block owned at its last exchange.
    none : no rows of each kind, by name as in a checkpoint.
    """

    def __init__(self, block: BlockFolder, own: BlockScene, number: int = 0, begins: Saved | None = None) -> None:
        super().__init__(block.run)
        self.block, self.own, self.number, self._begins = block, own, number, begins
        arrays = begins[0] if begins else {POSITIONS: np.empty((0, 3))}
        self.owned: NDArray[np.integer] = np.arange(len(arrays[POSITIONS]))
        self.none = _none_of(arrays)

    @property
    def has_checkpoint(self) -> bool:
        """As in `RunFolder`."""
        return self._begins is not None or super().has_checkpoint

    def load_checkpoint(self, wanted: Callable[[str], bool] = lambda name: True) -> Saved:
        """As in `RunFolder`; what it begins with is handed over once, as it takes much memory."""
        begins, self._begins = self._begins, None
        return begins or super().load_checkpoint(wanted)

    def _exchanges(self, iteration: int) -> bool:
        """Whether a checkpoint after so many steps is that at the exchange."""
        return self.number > 0 and iteration >= self.block.exchanges[self.number - 1]

    def saved_rows(self, iteration: int, positions: Callable[[], NDArray[np.floating]]) -> NDArray[np.integer] | None:
        """As in `RunFolder`: at the exchange those that the block owns."""
        if not self._exchanges(iteration):
            return None
        scene, region = self.own.scene.normalised(), self.own.region
        owned = np.flatnonzero(in_parts(lambda some: region.owns(world_of(scene, some)), positions()))
        self.owned = owned if len(owned) else np.zeros(1, int)  # a training begins with some
        return self.owned

    def save_checkpoint(self, arrays: Arrays, state: dict[str, Any]) -> None:
        """As in `RunFolder`, but for the checkpoint at the exchange."""
        if not self._exchanges(state["iteration"]):
            super().save_checkpoint(arrays, state)
            return
        scene, record = self.own.scene.normalised(), self.block.read()
        kept = {
            name: values
            for name, values in arrays.items()
            if name not in REPLACED and not name.startswith(f"{Average.name}.")
        }
        # a disk takes 1 GB/s of what all blocks write; a short file is noticed, see `_owned`
        with replacing(self.block.exchanged(self.number), synced=False) as file:
            write_npz(
                file,
                {
                    **kept,
                    STATE: state_array(
                        with_format(
                            {
                                TRAINING: state,
                                "unit": scene.unit,
                                "offset": scene.offset.tolist(),
                                CITY: record[CITY],
                                START: self.block.start(),
                            }
                        )
                    ),
                },
            )
        self.none = _none_of(kept)
        self.remove_checkpoint()

    def save_model(self, gaussians: Gaussians, offset: ArrayLike, comments: Iterable[str] = ()) -> None:
        """As in `RunFolder`, without the surroundings: they are others', and twice as many."""
        region, place = self.own.region, np.asarray(offset)
        reached = in_parts(lambda some: region.reaches(some.astype(np.float64) + place), gaussians.positions)
        super().save_model(selected(gaussians, reached) if reached.any() else gaussians, offset, comments)


def other_blocks(block: BlockFolder) -> list[BlockFolder]:
    """The blocks with which a block exchanges gaussians; InputError outside its city's folder."""
    city = CityFolder(block.path.absolute().parents[1])
    if not city.has_record:
        raise InputError(
            f"{block.path}: exchanges gaussians with the other blocks of its city; "
            "train it in the city's folder, or with --alone"
        )
    return [city.block(number) for number in block.others]


def lacking_blocks(others: Iterable[BlockFolder], number: int) -> list[str]:
    """Names of those `other_blocks` that have not come to the exchange `number`; InputError if one
    is of another partition."""
    for other in others:
        if other.is_there:
            other.check()
    return [other.path.name for other in others if other.last_exchange < number]


def remove_passed(blocks: Sequence[BlockFolder]) -> None:
    """Remove the files of exchanges that no block of a city needs any more; the last one of each
    block stays, for one that is trained again."""
    needed = min((block.last_exchange for block in blocks if not RunFolder(block.run).has_model), default=0)
    for block in blocks:
        for number in block.exchanges_there()[:-1]:
            if number < needed:
                block.exchanged(number).unlink(missing_ok=True)


def owned_at(block: BlockFolder, number: int) -> Saved:
    """What a block owned at an exchange, from 1, as a checkpoint that a training takes up there."""
    arrays, frame = _owned(block, number, block.read())
    state, count = frame[TRAINING], len(arrays[POSITIONS])
    # which are frozen the exchange finds
    return {
        **arrays,
        "frozen.rows": np.zeros(count, np.uint32),
        "adam.last_step": np.full(count, state["iteration"], np.uint32),
    }, state


def exchange(training: Training, run: BlockRun, others: Sequence[BlockFolder], options: SceneOptions) -> None:
    """Put what other blocks own in place of the margin and the surroundings of a block, whose
    training has come to an exchange. Gaussians of the margin bring the moments of their owner.

    Parameters
    ----------
    training, run : of the block, which has just been saved there, or begins at what it owned.
    others : its `other_blocks`; without them the margin and the surroundings are again as the block
        began with them.
    options : of the training.
    """
    rows = _beyond(training.session.device, run, others, options)
    by_kind: dict[str, Arrays] = {kind: {} for kind in BY_GAUSSIAN}
    for name, values in rows.items():
        kind, _, field = name.partition(".")
        by_kind.get(kind, {})[field] = values
    training.session.step.replace_others(run.owned, *by_kind.values())


def _beyond(device: Device, run: BlockRun, others: Sequence[BlockFolder], options: SceneOptions) -> Arrays:
    """What a block holds and does not own, by name as in a checkpoint; arguments as for `exchange`."""
    own, record = run.own, run.block.read()
    scene = own.scene.reduced(options.downscale, options.max_resolution).normalised()
    if others:
        return _of_others(device, run.none, others, run.number, record, scene, own.region)
    start = (
        read_ply(run.block.initial, scene.offset).scaled(1 / scene.unit).with_sh_degree(record["options"]["sh_degree"])
    )
    beyond = ~own.region.owns(world_of(scene, start.positions))
    rows = _zeros(run.none, int(beyond.sum()))
    for name, values in start.rows.items():
        rows[f"row.{name}"][:] = values[beyond]
    return rows


def _of_others(
    device: Device,
    none: Arrays,
    others: Sequence[BlockFolder],
    number: int,
    record: dict[str, Any],
    scene: Scene,
    region: Region,
) -> Arrays:
    """What a block holds of others, in the frame of its scene; `none` : no rows of each kind."""

    def places(other: BlockFolder) -> Arrays:
        return _in_frame_of(scene, *_owned(other, number, record, (POSITIONS, SCALES)))

    def take(other: BlockFolder, kind: str, of_other: NDArray[np.integer], begin: int) -> None:
        found, frame = _owned(other, number, record, [kind], of_other)
        for name, values in _in_frame_of(scene, found, frame).items():
            rows[name][begin : begin + len(of_other)] = values

    with ThreadPoolExecutor(READ_TOGETHER) as threads:
        there = list(threads.map(places, others))
        before = np.cumsum([0, *(len(each[SCALES]) for each in there)])
        positions, scales = (np.concatenate([each.pop(name) for each in there]) for name in (POSITIONS, SCALES))
        chosen = choose_gaussians(device, positions, scales, scene, region, scene.views)
        rows = _zeros(none, len(chosen.indices))
        ends = np.searchsorted(chosen.indices, before).tolist()
        jobs = [
            (other, kind, chosen.indices[begin:end] - skipped, begin)
            for other, skipped, begin, end in zip(others, before, ends, ends[1:])
            # none is trained where none is reached
            for kind in (BY_GAUSSIAN if chosen.reached[begin:end].any() else BY_GAUSSIAN[:1])
            if end > begin
        ]
        for _ in threads.map(lambda job: take(*job), jobs):
            pass  # an error is raised here
    rows[SCALES][:] = chosen.log_scales  # of which some are thinned
    return rows


def _zeros(none: Arrays, count: int) -> Arrays:
    """Arrays with so many rows."""
    return {name: np.zeros((count, *values.shape[1:]), values.dtype) for name, values in none.items()}


def _none_of(arrays: Arrays) -> Arrays:
    """No rows of those arrays that have a row a gaussian; copies, or all would stay in memory."""
    return {name: values[:0].copy() for name, values in arrays.items() if _is_by_gaussian(name)}


def _owned(
    block: BlockFolder,
    number: int,
    record: dict[str, Any],
    wanted: Collection[str] = (),
    rows: NDArray[np.integer] | None = None,
) -> tuple[Arrays, dict[str, Any]]:
    """What a block owned at an exchange, as arrays of a checkpoint, and the unit and the offset of
    its frame with the state of its training; InputError for a file that is damaged, or of another
    city or block.

    `record` : of the block that reads it; `wanted` : kinds or names of the arrays that it reads,
    besides statistics; none: all that there are; `rows` : of them, see `read_rows`; None: all."""
    # a block that is trained again finds others that have come farther
    path = block.exchanged(min((there for there in block.exchanges_there() if there >= number), default=number))
    cure = f"remove {path.parent}, and train that block again"
    with reading(path, "what a block owned at an exchange", cure):

        def by_gaussian(name: str) -> bool:
            return name in (*STATISTICS, *wanted) or name.partition(".")[0] in wanted

        if rows is None:
            arrays = read_npz(path, lambda name: not wanted or name == STATE or by_gaussian(name))
        else:
            arrays = {**read_npz(path, lambda name: name == STATE), **read_rows(path, by_gaussian, rows)}
        frame = state_of(path, arrays.pop(STATE))
        check_arrays(
            arrays, record["options"]["sh_degree"], [kind for kind in BY_GAUSSIAN if kind in wanted or not wanted]
        )
        if not (
            frame["unit"] > 0
            and np.shape(frame["offset"]) == (3,)
            and frame[TRAINING]["iteration"] > 0
            and set(wanted) - {*BY_GAUSSIAN} <= set(arrays)
        ):
            raise ValueError("its frame is none, or it lacks places")
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
        return values * factor ** LENGTHS[name] if name in LENGTHS else values

    return {name: moved(name, values).astype(values.dtype, copy=False) for name, values in owned.items()}


def _is_by_gaussian(name: str) -> bool:
    """Whether an array of a checkpoint, which exchanges contain too, has a row a gaussian."""
    return name.partition(".")[0] in BY_GAUSSIAN or name in STATISTICS
