"""Trains one block of a larger scene from its folder, which contains all that it needs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from clsplat.cities.exchange import exchange, lacking_blocks, other_blocks, write_owned
from clsplat.cities.jobs import Job, never
from clsplat.cities.scene import BlockScene
from clsplat.config.option import differences
from clsplat.device import Device, choose_device
from clsplat.errors import InputError, Interrupted, StopTraining
from clsplat.io.lock import LockTaken, latest_change
from clsplat.io.runs.city import BlockFolder
from clsplat.io.runs.run import OPTIONS, RunFolder
from clsplat.io.scenes.write import DEPTH
from clsplat.options import EARLIER, TrainOptions, checked_values, resolve
from clsplat.training.checkpoint import Saved
from clsplat.training.interrupt import was_interrupted
from clsplat.training.loop import resume, train
from clsplat.training.progress import NotedProgress, SilentProgress

# options that the coarse run decides, so that all blocks agree on colours and SH degree
DECIDED = ("exposure", "vignetting", "sh_degree")
BEFORE = "was finished before"
MOST_NAMED = 5  # blocks in a message
MAY_DIFFER = "init"  # a path in the block's folder, which may have been moved
LOCK_SECONDS = 300  # for a process without a sign of work, which may be saving its state


@dataclass(frozen=True)
class BlockJob(Job):
    """The training of a block, to its end or to an exchange.

    Attributes
    ----------
    block : its folder.
    until : the exchange, from 1, at which it stops once what others need is written; 0: none.
    alone : do without the exchanges that are left.
    """

    block: BlockFolder = BlockFolder("")
    until: int = 0
    alone: bool = False

    def run(self, device: Device, progress: SilentProgress | None = None,
            stopping: Callable[[], bool] = never) -> str:
        """Train the block; returns its state, see `train_block`.

        Another process that trains it is waited for as long as that works: a worker that the
        scheduler has lost may finish the block.
        """
        self.block.check()
        while True:
            before = latest_change(self.folder)
            try:
                return train_block(self.block, block_options(self.block), progress, LOCK_SECONDS,
                                   self.alone, device, self.until, stopping)
            except LockTaken:
                if latest_change(self.folder) == before:
                    raise


def decided_by(coarse: RunFolder) -> dict[str, Any]:
    """{option: value} that a coarse run has decided for all blocks."""
    decisions, path = coarse.read_options().get("decisions"), coarse.path / OPTIONS
    known = {**EARLIER, **decisions} if isinstance(decisions, dict) else {}
    if not set(DECIDED) <= set(known):
        raise InputError(f"{path}: damaged (decisions is {str(decisions)[:20]!r}); remove "
                         f"{coarse.path}, and train it again")
    return checked_values(str(path), {name: known[name] for name in DECIDED})


def options_of_blocks(given: dict[str, Any], decided: dict[str, Any]) -> dict[str, Any]:
    """{option: value} of every block, for `CityFolder.write_block`.

    Blocks have training views only, so none is held out. Degrees of spherical harmonics become
    active one after the other, as in any run, though gaussians of the coarse run have them from the
    start: with all of them active at once, blocks were not better.

    Parameters
    ----------
    given : those of the whole, with the steps of the block.
    decided : those of `decided_by`.
    """
    given = {name: value for name, value in given.items() if name != "images"}  # it has links
    depth = {"depth": DEPTH} if given.get("depth") else {}
    return {**given, **depth, **decided, "coarse": False, "test_every": 0, "test_offset": 0}


def block_options(block: BlockFolder, **changes: Any) -> TrainOptions:
    """The options in a block's folder, with changes; InputError for invalid ones."""
    values = checked_values(str(block.path), block.read()["options"])
    return resolve(values, {"init": str(block.initial), **changes})


def train_block(block: BlockFolder, options: TrainOptions,
                progress: SilentProgress | None = None, patience: float = 0.0,
                alone: bool = False, device: Device | None = None, until: int = 0,
                stopping: Callable[[], bool] = never) -> str:
    """Train a block to its end, from the start or from the last checkpoint of its run.

    It stops before, where it exchanges gaussians with blocks that have not come as far.

    Parameters
    ----------
    block : its folder.
    options : those of `block_options`.
    progress : receives steps, messages and phases.
    patience : seconds to wait for another process that trains the block.
    alone : do without the exchanges that are left.
    device : None: it is opened as `options` say.
    until, stopping : see `BlockJob`.

    Returns
    -------
    "finished", "was finished before", at which exchange it stops, or for which blocks it waits.

    Raises
    ------
    InputError : for a run that was begun with other options, or an exchange that there is not.
    """
    run, exchanges = RunFolder(block.run), [] if alone else block.exchanges
    if until > len(exchanges):
        raise InputError(f"{block.path}: there is no exchange {until}, as the block exchanges "
                         f"gaussians {len(exchanges)} times; give a smaller number, or none")
    if run.is_finished:  # checked before locking: the disk may be read-only
        _check_same(run, options)
        return BEFORE
    with run.locked(patience):
        if run.is_begun:
            _check_same(run, options)
        if run.is_finished:
            return BEFORE
        device = device or choose_device(options.device, form=options.form)
        others = other_blocks(block) if exchanges else []
        scene = BlockScene.read(block)
        saved: Saved | None = None  # what the latest exchange has made of the checkpoint
        for number, step in enumerate(exchanges, 1):
            if (taken := run.checkpoint_iteration()) <= step:
                latest = (_go_on(block, scene, options, device, progress, step, saved, stopping)
                          if taken < step else None)
                write_owned(block, scene, number, latest)
                del latest  # it takes as much memory as the exchange that follows
            if number == until:
                return f"stops at exchange {number} of {len(exchanges)}, after step {step}"
            if taken > step:
                continue
            if lacking := lacking_blocks(others, number):
                return (f"waits at exchange {number} of {len(exchanges)}, after step {step}: train "
                        f"{', '.join(lacking[:MOST_NAMED])}{' ...' * (len(lacking) > MOST_NAMED)} "
                        "too, then this block again")
            saved = exchange(block, scene, others, options, number, run)
        _go_on(block, scene, options, device, progress, 0, saved, stopping)
    return "finished"


def _go_on(block: BlockFolder, scene: BlockScene, options: TrainOptions, device: Device,
           progress: SilentProgress | None, until: int, saved: Saved | None,
           stopping: Callable[[], bool]) -> Saved | None:
    """Train until a step, or to the end if that is 0, from what is saved, or else from the run's
    checkpoint or the start; other arguments as for `train_block`. Returns the checkpoint at that
    step, None at the end."""
    run, latest = RunFolder(block.run), list[Saved]()
    noted = NotedProgress(run.path, progress or SilentProgress())
    parts = scene.parts(options)
    stop_at = min(filter(None, (until, options.stop_at)), default=0)
    changed = replace(options, stop_at=stop_at)

    def keep(written: Saved) -> None:
        if written[1]["iteration"] == until:
            latest.append(written)

    def stop(_: dict[str, Any]) -> None:
        if stopping():
            raise StopTraining

    try:
        if run.is_begun:
            resume(scene.scene, changed, device, run, noted, (stop,), on_save=keep, saved=saved,
                   parts=parts)
        else:
            train(scene.scene, changed, device, RunFolder.create(run.path), noted, (stop,),
                  on_save=keep, parts=parts)
    except Interrupted as stopped:
        if (not stopped.planned or was_interrupted(stopped) or stop_at == options.stop_at
                or stopping()):
            raise
    return latest[-1] if latest else None


def _check_same(run: RunFolder, options: TrainOptions) -> None:
    for name, recorded, present in differences(run.read_options(), options):
        if name != MAY_DIFFER:
            raise InputError(f"{run.path}: was begun with {name} {recorded}, and block.json has "
                             f"{present}; put that back, or remove the run")
