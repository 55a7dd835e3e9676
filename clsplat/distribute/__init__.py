"""Runs commands of clsplat as tasks: here one after the other, in processes, or on a Dask cluster.

    block = Path("CITY/blocks/000")
    outcomes = run([Task(block.name, ("block", str(block)), block / "run" / "point_cloud.ply")],
                   scheduler="tcp://10.0.0.1:8786")

Only names and paths travel. A task may be begun any number of times and goes on where it was: its
folder has a lock that ends with the process holding it, and a task whose `done` exists is not
begun. Each child has a kernel cache of its own. Workers of a cluster declare their devices:

    dask scheduler
    CLSPLAT_DEVICE=0 dask worker tcp://10.0.0.1:8786 --nthreads 1 --memory-limit 0 \\
        --resources device=1        # one a device; CLSPLAT_DEVICE as in `clsplat train --device`
"""

from clsplat.distribute.cluster import Cluster, check_scheduler
from clsplat.distribute.ledger import Ledger
from clsplat.distribute.local import InProcess, Processes
from clsplat.distribute.task import Outcome, Result, Task
from clsplat.errors import InputError, Interrupted

__all__ = ["Outcome", "Result", "Task", "check_scheduler", "check_workers", "run"]


MOST_WORKERS = 1024  # children of one machine


def check_workers(workers):
    """InputError for a number of children that no machine can have."""
    if not 1 <= workers <= MOST_WORKERS:
        raise InputError(f"--workers {workers}: wants 1 to {MOST_WORKERS}, as many as this machine "
                         "has devices or cores to spare")


def run(tasks, workers=1, scheduler="", retries=2, progress=None, *, devices=(), call=None,
        program="clsplat", began=None):
    """The Outcome of each Task, in their order, whether it went well or not.

    workers: children at a time on this machine. scheduler: address of a Dask scheduler, in place of
    them. retries: how often a failed task is tried again; one whose input is bad (exit code 2) is
    not. progress: called with each Outcome as it comes. devices: what CLSPLAT_DEVICE is in each
    child on this machine, in turn. call: with one worker, call(task) in place of a child; raises
    ClsplatError for bad input. program: the module that children run, with the task's command.
    began: called with a task's name when a try of it begins, maybe in another thread.

    Raises Interrupted on Ctrl-C: children are told to save their state and end. InputError where
    the cluster cannot be used.
    """
    check_workers(workers)
    ledger = Ledger(tasks, retries, progress, began)
    if not ledger.waiting:
        return ledger.in_order()
    if scheduler:
        pool = Cluster(scheduler, ledger.began, program)
    elif call and workers == 1:
        pool = InProcess(ledger.began, call)
    else:
        pool = Processes(ledger.began, min(workers, len(ledger.waiting)), devices, program)
    try:
        _drive(ledger, pool)
    except KeyboardInterrupt:
        raise Interrupted(
            f"stopped, {len(ledger.outcomes)} of {len(ledger.tasks)} tasks finished; those under "
            "way save their state, and the same command goes on with them") from None
    finally:
        pool.close()
    return ledger.in_order()


def _drive(ledger, pool):
    running = {}
    while ledger.waiting or running:
        while ledger.waiting and len(running) < pool.slots():
            task = ledger.waiting.popleft()
            running[pool.submit(task)] = task
        for future, result in pool.finished(running):
            ledger.settle(running.pop(future), result)
