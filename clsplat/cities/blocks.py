"""The training of a city's blocks, as jobs of this process, of several, or of a cluster."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

from clsplat.cities.block import BlockJob
from clsplat.cities.workers import Outcome, Workers
from clsplat.device import Device
from clsplat.errors import OutOfDeviceMemory
from clsplat.io.runs.city import DENSE, BlockFolder, CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.training.progress import SilentProgress


def train_blocks(city: CityFolder, workers: Workers, device: Device,
                 progress: Callable[[str], AbstractContextManager[SilentProgress | None]]
                 = lambda title: nullcontext(),
                 ended: Callable[[str, Outcome], object] = lambda title, outcome: None,
                 began: Callable[[str, str], object] = lambda title, name: None,
                 fill: bool = False) -> list[Outcome]:
    """Train the blocks that are not finished, the longest first; return the outcome of every block.

    Where blocks exchange gaussians, a block goes on as soon as those with which it does so have
    come as far. If one fails, they wait there, or go on alone.

    Parameters
    ----------
    workers : which train them.
    device : for trainings in this process.
    progress : called with a title such as "block 2 of 9", for a training in this process; returns
        the progress of that training.
    ended : called with such a title and each outcome.
    began : called with such a title and the name of a block that begins.
    fill : whether blocks go on alone when another has failed.
    """
    blocks = {block.path.name: block
              for block in sorted(city.blocks(), key=expected_work, reverse=True)}
    places = {name: f"block {place} of {len(blocks)}" for place, name in enumerate(blocks, 1)}

    def title(job: BlockJob) -> str:
        return job.name.replace(job.block.path.name, places[job.block.path.name], 1)

    def here(job: BlockJob) -> str:
        with progress(title(job)) as shown:
            return job.run(device, shown)

    def trained(jobs: Iterable[BlockJob]) -> dict[str, Outcome]:
        device_name = workers.devices[0] if len(workers.devices) == 1 else ""
        jobs = [replace(job, device=device_name or job.device) for job in jobs]
        return by_block(workers.run(
            jobs, here, lambda job: began(title(job), job.block.path.name),
            lambda outcome: ended(title(outcome.job), outcome)))

    outcomes = trained(jobs_of(city, list(blocks.values())))
    if fill and any(not outcome.ok for outcome in outcomes.values()):
        outcomes |= trained(job_of(block, alone=True) for name, block in blocks.items()
                            if outcomes[name].ok)
    return list(outcomes.values())


def jobs_of(city: CityFolder, blocks: Sequence[BlockFolder]) -> Iterator[BlockJob]:
    """The trainings of blocks to their first exchange, those to the next one, and to the end.

    A block that was finished without exchanges has written no files for them, and has no jobs for
    them.
    """
    stages = 1 + max((len(block.exchanges) for block in blocks), default=0)
    for stage in range(1, stages + 1):
        for block in blocks:
            if stage == stages or block.exchanged(stage).exists() or not RunFolder(
                    block.run).is_finished:
                needed = [block, *map(city.block, block.others)] if stage > 1 else []
                yield job_of(block, stage if stage < stages else 0, stages, tuple(
                    _name(other, stage - 1, stages) for other in needed))


def job_of(block: BlockFolder, until: int = 0, stages: int = 1, after: tuple[str, ...] = (),
           alone: bool = False) -> BlockJob:
    """The training of a block to its end, or to the exchange `until`; see `BlockJob`.

    Parameters
    ----------
    stages : the trainings of each block, of which this is one.
    after : names of jobs that must be finished before.
    """
    block = BlockFolder(block.path.resolve())
    options = block.read()["options"]
    return BlockJob(_name(block, until or stages, stages), block.run,
                    str(options.get("device", "auto")), str(options.get("form", "auto")), after,
                    block.exchanged(until) if until else RunFolder(block.run).model_path,
                    block, until, alone)


def _name(block: BlockFolder, stage: int, stages: int) -> str:
    return block.path.name + (f", stage {stage} of {stages}" if stages > 1 else "")


def by_block(outcomes: Iterable[Outcome]) -> dict[str, Outcome]:
    """{name of a block: the outcome that failed, or else that of its last job that was tried}."""
    found: dict[str, Outcome] = {}
    for outcome in outcomes:
        name = outcome.job.block.path.name
        before = found.get(name)
        if before is None or before.ok and (outcome.ok or outcome.tries):
            found[name] = outcome
    return found


def reason_of(outcome: Outcome) -> str:
    """Why a block failed, in one line with the cure."""
    if isinstance(outcome.error, OutOfDeviceMemory):
        return (f"{outcome.error}; or begin a new city with smaller blocks, by a finer --grid or "
                "fewer --block-gaussians")
    return str(outcome.error)


def expected_work(block: BlockFolder) -> int:
    """Steps of a block times the gaussians that it begins to train: its time, in some unit.

    Several workers end at about the same time if they begin with the longest jobs (Graham 1969).
    """
    record = block.read("own", "margin")
    steps = record["options"].get("iterations")  # checked when the block is trained
    gaussians: int = record["own"] + record["margin"] + record.get(DENSE, 0)
    return gaussians * (steps if type(steps) is int else 1)
