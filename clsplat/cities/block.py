"""The training of a city's blocks: of one from its folder, and of all, as jobs."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

from clsplat.cities.city import Shown
from clsplat.cities.exchange import BlockRun, exchange, lacking_blocks, other_blocks, owned_at, remove_passed
from clsplat.cities.jobs import Job
from clsplat.cities.scene import BlockScene
from clsplat.cities.workers import Outcome, Workers
from clsplat.config.option import differences
from clsplat.device import Device, choose_device
from clsplat.errors import InputError, Interrupted, OutOfDeviceMemory, StopTraining
from clsplat.io.runs.city import DENSE, BlockFolder, CityFolder, StageTime
from clsplat.io.runs.run import OPTIONS, RunFolder
from clsplat.io.scenes.write import DEPTH
from clsplat.options import TrainOptions, checked_values, resolve
from clsplat.training.interrupt import was_interrupted
from clsplat.training.loop import Training
from clsplat.training.progress import SilentProgress
from clsplat.training.run import training_of

# options that the coarse run decides, so that all blocks agree on colours and SH degree
DECIDED = ("exposure", "vignetting", "sh_degree")
BEFORE = "was finished before"
MOST_NAMED = 5  # blocks in a message
MAY_DIFFER = "init"  # a path in the block's folder, which may have been moved
LOCK_SECONDS = 300  # for another process, which may be saving its state


@dataclass(frozen=True)
class BlockJob(Job):
    """The training of a block, to its end or to an exchange.

    Attributes
    ----------
    block : its folder.
    until : the exchange, from 1, at which it stops once what others need is written; 0: none.
    alone : do without the exchanges that are left.
    rests : keep the training at an exchange for the block's next job in this process; there is
        memory for all that rest.
    """

    block: BlockFolder = BlockFolder("")
    until: int = 0
    alone: bool = False
    rests: bool = False

    @property
    def is_done(self) -> bool:
        """As in `Job`; also where the block has come to a later exchange."""
        return super().is_done or 0 < self.until < self.block.last_exchange

    def run(
        self, device: Device, progress: SilentProgress | None = None, stopping: Callable[[], bool] = lambda: False
    ) -> str:
        """Train the block; returns its state, see `train_block`.

        Another process that trains it is waited for: a worker that the scheduler has lost may
        finish the block.
        """
        self.block.check()
        return train_block(self.block, device, progress, self.until, self.alone, LOCK_SECONDS, stopping, self.rests)


@dataclass(frozen=True, eq=False)
class Begun:
    """The training of a block in this process."""

    training: Training
    run: BlockRun

    def close(self) -> None:
        """Give back its memory."""
        self.training.session.photos.close()


_resting: list[Begun] = []  # at most one, see `BlockJob.rests`


def _taken_up(block: BlockFolder, device: Device | None) -> Begun | None:
    """The training of a block that rests in this process, if it is on this device and no other
    process has continued it; another one ends."""
    if not _resting:
        return None
    begun = _resting.pop()
    if (
        begun.run.path.resolve() == block.run.resolve()
        and begun.training.session.device is device
        and block.last_exchange == begun.run.number
        and not begun.run.checkpoint_iteration()
    ):
        return begun
    begun.close()
    return None


def decided_by(coarse: RunFolder) -> dict[str, Any]:
    """{option: value} that a coarse run has decided for all blocks."""
    decisions, path = coarse.read_options().get("decisions"), coarse.path / OPTIONS
    known = decisions if isinstance(decisions, dict) else {}
    if not set(DECIDED) <= set(known):
        raise InputError(
            f"{path}: damaged (decisions is {str(decisions)[:20]!r}); remove {coarse.path}, and train it again"
        )
    return checked_values(str(path), {name: known[name] for name in DECIDED})


def options_of_blocks(given: dict[str, Any], decided: dict[str, Any]) -> dict[str, Any]:
    """{option: value} of every block, which has training views only, so that none is held out.

    `given` : those of the whole, with the steps of the block; `decided` : see `decided_by`."""
    given = {name: value for name, value in given.items() if name != "images"}  # it has links
    depth = {"depth": DEPTH} if given.get("depth") else {}
    return {**given, **depth, **decided, "coarse": False, "test_every": 0, "test_offset": 0}


def block_options(block: BlockFolder, **changes: Any) -> TrainOptions:
    """The options in a block's folder, with changes; InputError for invalid ones."""
    values = checked_values(str(block.path), block.read()["options"])
    return resolve(values, {"init": str(block.initial), **changes})


def train_block(
    block: BlockFolder,
    device: Device | None = None,
    progress: SilentProgress | None = None,
    until: int = 0,
    alone: bool = False,
    patience: float = 0.0,
    stopping: Callable[[], bool] = lambda: False,
    rests: bool = False,
    **changes: Any,
) -> str:
    """Train a block from its folder, which contains all that it needs: from the start or from the
    last checkpoint of its run, to the end or to an exchange with blocks that have not come as far.

    Returns "finished", "was finished before", at which exchange it stops, or for which blocks it
    waits. InputError for a run that was begun with other options.

    Parameters
    ----------
    device : None: it is opened as the options say.
    until, alone, rests : see `BlockJob`; `stopping` : see `Job.run`.
    patience : seconds to wait for another process that trains the block.
    changes : see `block_options`.
    """
    options = block_options(block, **changes)
    run, exchanges = RunFolder(block.run), block.exchanges

    def stop(_: dict[str, Any]) -> None:
        if stopping():
            raise StopTraining

    def step_of(number: int) -> int:
        """After which step an exchange is; 0 for 0."""
        return exchanges[number - 1] if number else 0

    def go_on(begun: Begun, number: int) -> None:
        """Train until an exchange, or to the end if that is 0; see `BlockRun`."""
        stop_at = min(filter(None, (step_of(number), options.stop_at)), default=0)
        session, begun.run.number = begun.training.session, number
        session.options = replace(session.options, stop_at=stop_at)
        try:
            begun.training.take(closes=False)
        except Interrupted as stopped:
            if not stopped.planned or was_interrupted(stopped) or stop_at == options.stop_at or stopping():
                raise

    with run.locked(patience):
        for name, recorded, present in differences(run.read_options(), options) if run.is_begun else ():
            if name != MAY_DIFFER:
                raise InputError(
                    f"{run.path}: was begun with {name} {recorded}, and block.json "
                    f"has {present}; put that back, or remove the run"
                )
        if run.is_finished:
            return BEFORE
        others = other_blocks(block) if exchanges and not alone else []
        begun, done = _taken_up(block, device), block.last_exchange
        opened = device or choose_device(options.device, form=options.form)
        with ExitStack() as stack:
            if begun:
                stack.callback(begun.close)
            scene = begun.run.own if begun else BlockScene.read(block)
            while True:
                place = f"exchange {done} of {len(exchanges)}, after step {step_of(done)}"
                if until and done >= until:
                    if begun and rests:
                        stack.pop_all()
                        _resting.append(begun)
                    return f"stops at {place}"
                exchanges_now = done and (begun or run.checkpoint_iteration() <= step_of(done))
                if exchanges_now and (lacking := lacking_blocks(others, done)):
                    more = " ..." * (len(lacking) > MOST_NAMED)
                    return f"waits at {place}: train {', '.join(lacking[:MOST_NAMED])}{more} too, then this block again"
                if not begun:
                    own = BlockRun(block, scene, done, owned_at(block, done) if exchanges_now else None)
                    begun = Begun(
                        training_of(
                            scene.scene, options, opened, own, progress, (stop,), scene.parts(options.exposure == "on")
                        ),
                        own,
                    )
                    stack.callback(begun.close)
                if exchanges_now:
                    if progress:
                        progress.phase("exchanging gaussians with other blocks")
                    exchange(begun.training, begun.run, others, options)
                last = alone or done == len(exchanges)
                done = 0 if last else done + 1
                go_on(begun, done)
                if last:
                    return "finished"
                if others:
                    remove_passed(CityFolder(block.path.absolute().parents[1]).blocks())


def train_blocks(
    city: CityFolder, workers: Workers, device: Device, shown: Shown | None = None, fill: bool = False
) -> list[Outcome]:
    """Train the blocks that are not finished, the longest first; return the outcome of every block.

    Where blocks exchange gaussians, a block goes on as soon as those with which it does so have
    come as far. If one fails, they wait there, or with `fill` go on alone. `workers` train them, or
    this process on `device`.
    """
    shown = shown or Shown()
    blocks = {block.path.name: block for block in sorted(city.blocks(), key=_expected_work, reverse=True)}
    # each block has a process, which need not read it again
    rests = workers.number >= len(blocks) > 1 and not workers.scheduler
    places = {name: f"block {place} of {len(blocks)}" for place, name in enumerate(blocks, 1)}

    def title(job: BlockJob) -> str:
        return job.name.replace(job.block.path.name, places[job.block.path.name], 1)

    def here(job: BlockJob) -> str:
        with shown.stage(title(job)) as progress:
            return job.run(device, progress)

    def began(job: BlockJob) -> None:
        if workers.several:
            shown.line(f"{title(job)}: training in blocks/{job.block.path.name}")

    def ended(outcome: Outcome) -> None:
        name = outcome.job.name + ("" if outcome.ok else ", failed")
        city.add_stage(StageTime(name, outcome.worker, time.time() - outcome.seconds, outcome.seconds))
        shown.line(
            f"{title(outcome.job)} (blocks/{outcome.job.block.path.name}): "
            f"{'finished' if outcome.ok else 'failed'} after {outcome.seconds:.0f} s"
        )

    def trained(jobs: Iterable[BlockJob]) -> dict[str, Outcome]:
        device_name = workers.devices[0] if len(workers.devices) == 1 else ""
        return _by_block(
            workers.run(
                [replace(job, device=device_name or job.device, rests=rests) for job in jobs], here, began, ended
            )
        )

    outcomes = trained(jobs_of(city, list(blocks.values())))
    if fill and any(not outcome.ok for outcome in outcomes.values()):
        outcomes |= trained(job_of(block, alone=True) for name, block in blocks.items() if outcomes[name].ok)
    for outcome in outcomes.values():
        if not outcome.ok:
            shown.failure(f"block {outcome.job.block.path.name} failed on {outcome.worker}: {_reason_of(outcome)}")
    return list(outcomes.values())


def jobs_of(city: CityFolder, blocks: Sequence[BlockFolder]) -> Iterator[BlockJob]:
    """The trainings of blocks to their first exchange, those to the next one, and to the end.

    A block that was finished without exchanges has no jobs for them.
    """
    stages = 1 + max((len(block.exchanges) for block in blocks), default=0)
    for stage in range(1, stages + 1):
        for block in blocks:
            if stage == stages or stage <= block.last_exchange or not RunFolder(block.run).is_finished:
                needed = [block, *map(city.block, block.others)] if stage > 1 else []
                yield job_of(
                    block,
                    stage if stage < stages else 0,
                    stages,
                    tuple(_name(other, stage - 1, stages) for other in needed),
                )


def job_of(
    block: BlockFolder, until: int = 0, stages: int = 1, after: tuple[str, ...] = (), alone: bool = False
) -> BlockJob:
    """The training of a block, one of `stages`; see `BlockJob`."""
    block = BlockFolder(block.path.resolve())
    options = block.read()["options"]
    return BlockJob(
        _name(block, until or stages, stages),
        block.run,
        str(options.get("device", "auto")),
        str(options.get("form", "auto")),
        after,
        block.exchanged(until) if until else RunFolder(block.run).model_path,
        block,
        until,
        alone,
    )


def _name(block: BlockFolder, stage: int, stages: int) -> str:
    return block.path.name + (f", stage {stage} of {stages}" if stages > 1 else "")


def _by_block(outcomes: Iterable[Outcome]) -> dict[str, Outcome]:
    """{name of a block: the outcome of its first job that was tried and failed, or else of its
    first one}."""
    found: dict[str, Outcome] = {}
    for outcome in sorted(outcomes, key=lambda outcome: outcome.ok or not outcome.tries):
        found.setdefault(outcome.job.block.path.name, outcome)
    return found


def _reason_of(outcome: Outcome) -> str:
    """Why a block failed, in one line with the cure."""
    if isinstance(outcome.error, OutOfDeviceMemory):
        return f"{outcome.error}; or begin a new city with smaller blocks, by a finer --grid or fewer --block-gaussians"
    return str(outcome.error)


def _expected_work(block: BlockFolder) -> int:
    """Steps of a block times the gaussians that it begins to train: its time, in some unit.

    Several workers end at about the same time if they begin with the longest jobs (Graham 1969).
    """
    record = block.read("own", "margin")
    steps = record["options"].get("iterations")  # checked when the block is trained
    gaussians: int = record["own"] + record["margin"] + record.get(DENSE, 0)
    return gaussians * (steps if type(steps) is int else 1)
