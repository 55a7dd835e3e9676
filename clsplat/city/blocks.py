"""The training of a city's blocks: as tasks of this process, of several, or of a cluster."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

from clsplat.city.cut import cut_into_blocks
from clsplat.city.split import split_blocks, too_large
from clsplat.device import Device
from clsplat.distribute import ONE_WORKER, Outcome, Task, Workers
from clsplat.io.runs.city import DENSE, BlockFolder, CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.options import TrainOptions
from clsplat.partition.input import world_of
from clsplat.scene import Scene
from clsplat.training.block import block_options, train_block
from clsplat.training.progress import SilentProgress

ALONE = "--alone"  # without exchanges
UNTIL = "--until-exchange"  # a task ends as soon as its file is there, for which others wait
MOST_SPLITS = 4  # of a block, one after the other


def train_blocks(city: CityFolder, workers: Workers = ONE_WORKER,
                 progress: Callable[[str], AbstractContextManager[SilentProgress | None]]
                 | None = None,
                 ended: Callable[[Outcome, str], object] | None = None,
                 began: Callable[[str, str], object] | None = None,
                 fill: bool = False, device: Device | None = None) -> list[Outcome]:
    """Train the blocks that are not finished, the longest first; return the outcome of every block.

    Where blocks exchange gaussians, a block goes on as soon as those with which it does so have
    come as far. If one fails, they wait there, or go on alone.

    Parameters
    ----------
    workers : which train them.
    progress : called with a title such as "block 2 of 9", for a training in this process; returns
        the progress of that training.
    ended : called with each outcome and such a title.
    began : called with the name of a block that begins and such a title.
    fill : whether blocks go on alone when another has failed.
    device : for trainings in this process; None: each opens its own.
    """
    blocks = {block.path.name: block
              for block in sorted(city.blocks(), key=expected_work, reverse=True)}
    places = {name: f"block {place} of {len(blocks)}" for place, name in enumerate(blocks, 1)}
    devices = workers.devices
    chosen = ("--device", devices[0]) if len(devices) == 1 and not workers.scheduler else ()

    def title_of(task: str) -> str:
        return ", ".join(filter(None, (places[block_of(task)], task.partition(" ")[2])))

    def in_this_process(task: Task) -> None:
        block = blocks[block_of(task.name)]
        block.check()
        options = block_options(block, **({"device": devices[0]} if devices else {}))
        with progress(title_of(task.name)) if progress else nullcontext() as shown:
            train_block(block, options, shown, alone=ALONE in task.command, device=device,
                        until=until_of(task))

    def trained(tasks: Iterable[Task]) -> dict[str, Outcome]:
        return by_block(workers.run(
            [replace(task, command=(*task.command, *chosen)) for task in tasks],
            call=in_this_process,
            progress=ended and (lambda outcome: ended(named(outcome),
                                                      title_of(outcome.task.name))),
            began=began and (lambda task: began(block_of(task), title_of(task)))))

    outcomes = trained(tasks_of(city, blocks.values()))
    failed = [outcome for outcome in outcomes.values() if not outcome.ok]
    if failed and fill and not too_large(failed):
        outcomes |= trained(task_alone(block) for name, block in blocks.items()
                            if outcomes[name].ok)
    return list(outcomes.values())


def tasks_of(city: CityFolder, blocks: Iterable[BlockFolder]) -> Iterator[Task]:
    """The trainings of blocks to their first exchange, those to the next one, and to the end.

    A block that was finished without exchanges has written no parts, and has no tasks for them.
    """
    blocks = list(blocks)
    parts = 1 + max((len(block.exchanges) for block in blocks), default=0)
    for number in range(1, parts + 1):
        for block in blocks:
            run_folder = RunFolder(block.run)
            done = run_folder.model_path if number == parts else block.part(number)
            if parts == 1:
                yield Task(block.path.name, command_of(block), done)
            elif done.exists() or not run_folder.is_finished:
                needed = [block, *map(city.block, block.others)] if number > 1 else []
                until = (UNTIL, str(number)) if number < parts else ()
                yield Task(f"{block.path.name} part {number} of {parts}",
                           (*command_of(block), *until), done,
                           tuple(f"{other.path.name} part {number - 1} of {parts}"
                                 for other in needed))


def task_alone(block: BlockFolder) -> Task:
    """The training of a block to its end, without the exchanges that are left."""
    return Task(block.path.name, (*command_of(block), ALONE), RunFolder(block.run).model_path)


def command_of(block: BlockFolder) -> tuple[str, ...]:
    """The arguments of `clsplat` that train a block until it waits for others."""
    return "block", str(block.path.resolve()), "-q"


def until_of(task: Task) -> int:
    """The exchange at which the training of a task stops; 0: none."""
    return int(task.command[task.command.index(UNTIL) + 1]) if UNTIL in task.command else 0


def block_of(task: str) -> str:
    """The name of the block whose training is the task of this name."""
    return task.partition(" ")[0]


def named(outcome: Outcome) -> Outcome:
    """The outcome of a block's task, under the name of the block."""
    return replace(outcome, task=replace(outcome.task, name=block_of(outcome.task.name)))


def by_block(outcomes: Iterable[Outcome]) -> dict[str, Outcome]:
    """{name of a block: the outcome that failed, or else that of its last task that was tried}."""
    found: dict[str, Outcome] = {}
    for outcome in map(named, outcomes):
        before = found.get(outcome.task.name)
        if before is None or before.ok and (outcome.ok or outcome.tries):
            found[outcome.task.name] = outcome
    return found


def expected_work(block: BlockFolder) -> int:
    """Steps of a block times the gaussians that it begins to train: its time, in some unit.

    Several workers end at about the same time if they begin with the longest tasks (Graham 1969).
    """
    record = block.read("own", "margin")
    steps = record["options"].get("iterations")  # checked when the block is trained
    gaussians: int = record["own"] + record["margin"] + record.get(DENSE, 0)
    return gaussians * (steps if type(steps) is int else 1)


def train_all_blocks(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                     train_present: Callable[[], list[Outcome]]) -> list[Outcome]:
    """Train all blocks by `train_present`, which calls `train_blocks`; those that do not fit their
    device are cut in two."""
    outcomes = train_present()
    for _ in range(MOST_SPLITS):
        numbers = too_large(outcomes)
        if not numbers:
            break
        gaussians = RunFolder(city.coarse).load_model()
        _, whole = split_blocks(city, scene, numbers, world_of(scene, gaussians.positions))
        if len(whole) == len(numbers):
            break
        cut_into_blocks(city, scene, options, None, device)
        outcomes = train_present()
    return outcomes
