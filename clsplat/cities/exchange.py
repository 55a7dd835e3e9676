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
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.models.ply import START
from clsplat.io.npz import read_npz, state_array, write_npz
from clsplat.io.records import object_of
from clsplat.io.runs.city import BlockFolder, CityFolder
from clsplat.io.runs.run import STATE, RunFolder
from clsplat.options import SceneOptions
from clsplat.partition.blocks import block_start, trainable
from clsplat.scene import Scene
from clsplat.training.checkpoint import Arrays, Saved, gaussians_of
from clsplat.training.recorder import LOG_EVERY

STATISTICS = ("statistics.grad_norm_sum", "statistics.seen_count")
SCALES = "row.log_scales"
PLACED = ("row.positions", SCALES, "row.quaternions")  # where a gaussian is, and how large
# arrays of what is owned -> power of a length; gradients by positions have one over a length
LENGTHS = {"row.max_offsets": 1, "m.positions": -1, "v.positions": -2}
READ_TOGETHER = 4  # files, so that not all of them are in memory
DAMAGED = "damaged"
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


def write_owned(block: BlockFolder, own: BlockScene, number: int, saved: Saved | None) -> None:
    """Write what a block owns, with Adam's moments, unless that was done before.

    `own` : the block as it was read; `number` : of the exchange, from 1; `saved` : the checkpoint
    at the exchange; None: that of the block's run is read."""
    path = block.exchanged(number)
    if path.exists():
        return
    scene = own.scene.normalised()
    arrays, _ = saved or RunFolder(block.run).load_checkpoint(_is_by_gaussian)
    arrays = {name: values for name, values in arrays.items() if _is_by_gaussian(name)}
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
             options: SceneOptions, number: int, run: RunFolder) -> Saved:
    """Replace a block's margin and surroundings by what other blocks own.

    Returns the checkpoint from which the block goes on; that of its run stays as it is. Gaussians
    of the margin bring the moments of their owner.

    Parameters
    ----------
    block, read, others : its folder, the block as it was read, and its `other_blocks`.
    options, number : of its training; of the exchange, from 1.
    run : of the block, with a checkpoint at the exchange; its rows are in the block's file.
    """
    record = block.read()
    arrays, state = run.load_checkpoint(lambda name: not _is_by_gaussian(name))
    scene = read.scene.reduced(options.downscale, options.max_resolution).normalised()
    region = read.region

    def taken_from(other: BlockFolder) -> Arrays:
        """What the block holds of another one."""
        owned = Owned(other, number, record)
        placed = _in_frame_of(scene, {name: owned.rows[name] for name in PLACED}, owned.frame)
        start = block_start(
            Gaussians.padded({name.removeprefix("row."): rows for name, rows in placed.items()}),
            scene, region, scene.views)
        taken = _in_frame_of(scene, owned.arrays(start.indices), owned.frame)
        # which may be thinned
        taken[SCALES] = start.gaussians.log_scales.astype(owned.rows[SCALES].dtype)
        return taken

    with ThreadPoolExecutor(READ_TOGETHER) as threads:
        found = list(threads.map(taken_from, others))
        owned = Owned(block, number, record).arrays()
        new = dict(zip(owned, threads.map(lambda name: np.concatenate(
            [owned[name], *(taken[name] for taken in found)]), owned)))
    trains = trainable(scene, region, new["row.positions"], new[SCALES])
    return {**arrays, **new, "frozen.rows": (~trains).astype(np.uint32),
            "adam.last_step": np.full(len(trains), state["iteration"], np.uint32)}, state


class Owned:
    """What a block owned at an exchange, in its file; InputError if that is damaged, or of another
    city or block. `record` : of the block that reads it.

    Attributes
    ----------
    rows : arrays of a checkpoint with a row a gaussian, without moments.
    frame : the unit and the offset of the block.
    """

    def __init__(self, block: BlockFolder, number: int, record: dict[str, Any]) -> None:
        path = block.exchanged(number)
        self._path, self._cure = path, f"remove {path.parent}, and train that block again"
        self.rows = read_npz(path, DAMAGED, self._cure, lambda name: name == STATE or _is_row(name))
        try:
            self.frame = object_of(self.rows.pop(STATE).tobytes())
            self._check(self.rows, moments=False)
            if not (self.frame["unit"] > 0 and np.shape(self.frame["offset"]) == (3,)):
                raise ValueError("its frame")
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: {DAMAGED} ({error}); {self._cure}") from None
        if (self.frame.get(CITY), self.frame.get(START)) != (record[CITY], block.start()):
            raise InputError(f"{path}: of another city, block or partition than {block.path}; "
                             f"{self._cure}")

    def arrays(self, indices: NDArray[np.integer] | None = None) -> Arrays:
        """Rows of gaussians with their moments and statistics; InputError if they are damaged.

        Most of the file is moments, and other blocks need few of them. `indices` : int[K],
        ascending, of the gaussians; None: all.
        """
        rows = self.rows if indices is None else {
            name: values[indices] for name, values in self.rows.items()}
        found = {**rows, **read_npz(self._path, DAMAGED, self._cure, lambda name: name != STATE
                                    and not _is_row(name), indices)}
        try:
            self._check(found, moments=True)
        except (KeyError, ValueError) as error:
            raise InputError(f"{self._path}: {DAMAGED} ({error}); {self._cure}") from None
        return found

    @staticmethod
    def _check(arrays: Arrays, moments: bool) -> None:
        degree = int(np.sqrt(arrays["row.sh_rest"].shape[1] + 1)) - 1
        gaussians_of(arrays, degree, moments=moments)


def _in_frame_of(scene: Scene, owned: Arrays, frame: dict[str, Any]) -> Arrays:
    """Some or all arrays of an `Owned`, with its frame, in the frame of another block's scene."""
    factor = frame["unit"] / scene.unit
    moved = dict(owned)
    for name in ("row.positions", "row.anchors"):
        if name in owned:
            world = np.asarray(frame["offset"]) + frame["unit"] * owned[name].astype(float)
            moved[name] = ((world - scene.offset) / scene.unit).astype(owned[name].dtype)
    for name, power in LENGTHS.items():
        if name in owned:
            moved[name] = (owned[name] * factor**power).astype(owned[name].dtype)
    if SCALES in owned:
        moved[SCALES] = (owned[SCALES] + np.log(factor)).astype(owned[SCALES].dtype)
    return moved


def _is_by_gaussian(name: str) -> bool:
    """Whether an array of a checkpoint that an `Owned` has too has a row a gaussian."""
    return _is_row(name) or name.partition(".")[0] in ("m", "v") or name in STATISTICS


def _is_row(name: str) -> bool:
    """Whether an array of a checkpoint is a field of its gaussians."""
    return name.startswith("row.")
