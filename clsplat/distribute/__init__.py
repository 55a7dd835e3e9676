"""Run commands of clsplat as tasks: one after the other, in processes, or on a Dask cluster.

    block = Path("CITY/blocks/000")
    outcomes = run([Task(block.name, ("block", str(block)), block / "run" / "point_cloud.ply")],
                   scheduler="tcp://10.0.0.1:8786")

Only names and paths are sent. A task may be started any number of times and continues where it
stopped: its folder has a lock that ends with the process that holds it, and a task whose `done`
exists is not started. Each child has its own kernel cache. Workers of a cluster declare devices:

    dask scheduler
    CLSPLAT_DEVICE=0 dask worker tcp://10.0.0.1:8786 --nthreads 1 --memory-limit 0 \\
        --resources device=1        # one for each device, named as in `clsplat train --device`
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from clsplat.distribute.cluster import Cluster, check_scheduler
from clsplat.distribute.ledger import Ledger
from clsplat.distribute.local import Children, InProcess, Processes
from clsplat.distribute.task import Outcome, Pool, Result, Task
from clsplat.errors import InputError, Interrupted

__all__ = ["ONE_WORKER", "Children", "Outcome", "Result", "Task", "Workers", "check_scheduler",
           "check_workers", "run"]

MOST_WORKERS = 1024  # children of one machine


def check_workers(workers: int) -> None:
    """Raise InputError for a number of child processes that no machine can run."""
    if not 1 <= workers <= MOST_WORKERS:
        raise InputError(f"--workers {workers}: expects 1 to {MOST_WORKERS}, as many as this "
                         "machine has free devices or cores")


def run(tasks: Sequence[Task], workers: int = 1, scheduler: str = "", retries: int = 2,
        progress: Callable[[Outcome], object] | None = None, *, devices: Sequence[str] = (),
        call: Callable[[Task], object] | None = None, program: str = "clsplat",
        began: Callable[[str], object] | None = None,
        children: Children | None = None) -> list[Outcome]:
    """Run tasks until each is finished or has failed.

    Parameters
    ----------
    tasks : with names that differ.
    workers : the number of child processes on this machine.
    scheduler : the address of a Dask scheduler, whose workers are used instead.
    retries : how often a failed task is tried again, unless its input is invalid (exit code 2).
    progress : called with each Outcome as soon as it is known.
    devices : values of CLSPLAT_DEVICE that the children on this machine use in turn.
    call : with one worker, called with a task instead of starting a child; it raises ClsplatError
        for invalid input.
    program : the module that children run, with the task's command as arguments.
    began : called with a task's name when a try of it begins, possibly in another thread.
    children : which stay after the run, in place of new ones of which there are `workers`.

    Returns
    -------
    The Outcome of each task, in the order of the tasks.

    Raises
    ------
    Interrupted : on Ctrl-C; the children are told to save their state and end.
    InputError : the cluster cannot be used.
    """
    check_workers(workers)
    ledger = Ledger(tasks, retries, progress, began)
    if not ledger.waiting:
        return ledger.in_order()
    pool: Pool
    own: Children | None = None  # they end with this run
    if scheduler:
        pool = Cluster(scheduler, ledger.began, program)
    elif call and workers == 1:
        pool = InProcess(ledger.began, call)
    else:
        children = children or (own := Children(min(workers, len(ledger.waiting)), devices))
        pool = Processes(ledger.began, children, program)
    try:
        _drive(ledger, pool)
    except KeyboardInterrupt:
        raise Interrupted(
            f"stopped, {len(ledger.outcomes)} of {len(ledger.tasks)} tasks finished; the running "
            "ones save their state, and the same command continues them") from None
    finally:
        pool.close()
        if own:
            own.close()
    return ledger.in_order()


@dataclass(frozen=True)
class Workers:
    """Where all tasks of a command run.

    Attributes
    ----------
    number, scheduler, devices, children : as for `run`, where the first is called `workers`.
    """

    number: int = 1
    scheduler: str = ""
    devices: tuple[str, ...] = ()
    children: Children | None = None

    @property
    def several(self) -> bool:
        """Whether tasks run in other processes."""
        return self.number > 1 or bool(self.scheduler)

    def run(self, tasks: Sequence[Task], progress: Callable[[Outcome], object] | None = None,
            call: Callable[[Task], object] | None = None, program: str = "clsplat",
            began: Callable[[str], object] | None = None) -> list[Outcome]:
        """Run tasks until each is finished or has failed; for all else see `run`."""
        return run(tasks, self.number, self.scheduler, progress=progress, devices=self.devices,
                   call=call, program=program, began=began, children=self.children)


ONE_WORKER = Workers()


def _drive(ledger: Ledger, pool: Pool) -> None:
    running: dict[Any, Task] = {}
    while running or ledger.can_begin:
        while len(running) < pool.slots() and (task := ledger.next_task()):
            running[pool.submit(task)] = task
        for future, result in pool.finished(running):
            ledger.settle(running.pop(future), result)
    ledger.give_up()  # what waits for a task that failed
