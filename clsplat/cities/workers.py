"""Runs jobs in this process, in processes of this machine, or on a Dask cluster.

Executors of `concurrent.futures` and a client of `distributed` run them alike, as their futures
have one protocol. A worker that dies is replaced.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import socket
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.cities.cluster import Cluster
from clsplat.cities.jobs import HERE, Job, Lost, Unfit, device_here, line_of
from clsplat.errors import ClsplatError, InputError, Interrupted
from clsplat.io.folders import make_folder
from clsplat.io.lock import LockTaken
from clsplat.training.interrupt import was_interrupted

MOST_WORKERS = 1024  # of one machine
MOST_TRIES = 4  # of a job that fails, unless its input is invalid, or whose worker disappears
POLL_SECONDS = 0.05
GRACE_SECONDS = 120  # for a job whose parent process has died to save its state
LOG = "log.txt"  # in a job's folder: what its processes print
STOP = "clsplat_stop"  # attribute of a process of a pool: the event that stops its job
INTERRUPTED = 130  # exit code

log = logging.getLogger(__name__)
_busy = threading.Lock()  # held in a process of a pool while it runs a job


@dataclass(frozen=True)
class Outcome:
    """The end of a job.

    Attributes
    ----------
    job, worker : the job, and the last one that ran it.
    value : what it returned; None if it was finished before, or failed.
    error : why it failed; None: it did not.
    seconds, tries : since it was first begun; how often it was tried.
    """

    job: Any
    value: Any = None
    error: Exception | None = None
    seconds: float = 0.0
    tries: int = 0
    worker: str = ""

    @property
    def ok(self) -> bool:
        """Whether the job is finished."""
        return self.error is None


class Workers(AbstractContextManager["Workers"]):
    """Where the jobs of a command run; a context, at whose end its processes end.

    Parameters
    ----------
    number : of processes on this machine.
    scheduler : address of a Dask scheduler, whose workers are used instead.
    devices : values of CLSPLAT_DEVICE that the processes use in turn, from the last one, as this
        process works on the first one.
    """

    def __init__(self, number: int = 1, scheduler: str = "", devices: Sequence[str] = ()) -> None:
        if not 1 <= number <= MOST_WORKERS:
            raise InputError(
                f"--workers {number}: expects 1 to {MOST_WORKERS}, as many as this machine has free devices or cores"
            )
        self.number, self.scheduler, self.devices = number, scheduler, tuple(devices)
        self._pool: Cluster | _Processes | None = None

    @property
    def several(self) -> bool:
        """Whether jobs run in other processes."""
        return self.number > 1 or bool(self.scheduler)

    def __exit__(self, *error: object) -> None:
        self.close()

    def run(
        self,
        jobs: Sequence[Job],
        here: Callable[[Any], Any],
        began: Callable[[Any], object] = lambda job: None,
        ended: Callable[[Outcome], object] = lambda outcome: None,
    ) -> list[Outcome]:
        """Run jobs, the first ones first, until each is finished or has failed.

        A job that was finished before gets an Outcome without tries, which is not reported.

        Parameters
        ----------
        here : runs a job in this process, if there are no other ones.
        began, ended : called with each job that begins, and with each Outcome.

        Returns
        -------
        The Outcome of each job, in the order of the jobs.

        Raises
        ------
        Interrupted : on Ctrl-C; running jobs save their state and end.
        InputError : the cluster cannot be used.
        """
        outcomes = {job.name: Outcome(job) for job in jobs if job.is_done}
        waiting = [job for job in jobs if job.name not in outcomes]
        tries, begun, running = Counter[str](), dict[str, float](), dict[Any, Job]()

        def awaited(job: Job) -> str:
            """The first job that must be finished before this one and is not; "" for none."""
            return next((name for name in job.after if name not in outcomes or not outcomes[name].ok), "")

        for job in waiting:
            make_folder(job.folder)
        pool = self._opened(here) if waiting else _InProcess(here)
        try:
            while running or not all(map(awaited, waiting)):
                ready = [job for job in waiting if not awaited(job)]
                for job in ready[: max(0, pool.slots() - len(running))]:
                    waiting.remove(job)
                    tries[job.name] += 1
                    begun.setdefault(job.name, time.monotonic())
                    began(job)
                    running[pool.submit(job)] = job
                done = [future for future in running if future.done()]
                for future in done:
                    job = running.pop(future)
                    value, error, worker = _settled(pool, future)
                    final = isinstance(error, ClsplatError) and not isinstance(error, (Unfit, Interrupted, LockTaken))
                    if error and not final and tries[job.name] < MOST_TRIES:
                        waiting.append(job)
                        continue
                    outcomes[job.name] = Outcome(
                        job, value, error, time.monotonic() - begun[job.name], tries[job.name], worker
                    )
                    ended(outcomes[job.name])
                if not done:
                    time.sleep(POLL_SECONDS)
        except KeyboardInterrupt:
            self.close()
            raise Interrupted(
                f"stopped, {len(outcomes)} of {len(jobs)} jobs finished; the running ones save "
                "their state, and the same command continues them"
            ) from None
        return [
            outcomes.get(job.name) or Outcome(job, error=InputError(f"it waits for {awaited(job)}")) for job in jobs
        ]

    def begin(self, job: Job) -> Future[Any] | None:
        """Begin a job beside what this process does on the first device, see `end`; None: there is
        no process with another one."""
        if job.is_done or not (self.scheduler or self.several and len(set(self.devices)) > 1):
            return None
        make_folder(job.folder)
        future: Future[Any] = self._opened(_InProcess).submit(job)
        return future

    def end(self, future: Future[Any] | None) -> tuple[Any, str] | None:
        """What a job that was begun returned, and its worker; None where it failed, or was none.

        Waits, and raises Interrupted on Ctrl-C."""
        if future is None or self._pool is None:
            return None
        try:
            while not future.done():
                self._pool.slots()  # raises an error where a cluster has no workers
                time.sleep(POLL_SECONDS)
        except KeyboardInterrupt:
            self.close()
            raise Interrupted("stopped; the same command continues") from None
        value, error, worker = _settled(self._pool, future)
        return None if error else (value, worker)

    def _opened(self, here: Callable[[Any], Any]) -> _Pool:
        if self.several and not self._pool:
            self._pool = Cluster(self.scheduler) if self.scheduler else _Processes(self.number, self.devices)
        return self._pool or _InProcess(here)

    def close(self) -> None:
        """End the processes; those that work save their state before."""
        if self._pool:
            self._pool.close()
            self._pool = None


def _settled(pool: _Pool, future: Any) -> tuple[Any, Exception | None, str]:
    """What a job returned, or the error that it raised, and its worker."""
    try:
        value, worker = pool.result(future)
        return value, None, worker
    except Exception as error:  # noqa: BLE001  (another machine may raise anything)
        return None, error, HERE


class _InProcess:
    """Runs one job at a time, in the thread that receives Ctrl-C."""

    def __init__(self, call: Callable[[Any], Any]) -> None:
        self._call = call

    def slots(self) -> int:
        return 1

    def submit(self, job: Job) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(self._call(job))
        except Interrupted:
            raise
        except Exception as error:  # noqa: BLE001  (the other jobs are still run)
            if was_interrupted(error):
                raise KeyboardInterrupt from None
            if not isinstance(error, ClsplatError):
                log.exception("%s failed", job.name)
            future.set_exception(error)
        return future

    def result(self, future: Future[Any]) -> tuple[Any, str]:
        return future.result(), HERE

    def close(self) -> None:
        pass


@dataclass
class _Process:
    """A process of this machine; `device` : its CLSPLAT_DEVICE, "" for that of this process;
    `future`, `folder` : of its latest job."""

    device: str
    executor: ProcessPoolExecutor | None = None
    future: Future[Any] | None = None
    folder: Path | None = None

    @property
    def failed(self) -> bool:
        """Whether the latest job failed; waits for it."""
        return self.future is not None and self.future.exception() is not None


class _Processes:
    """Processes of this machine; `number`, `devices` as for `Workers`."""

    def __init__(self, number: int, devices: Sequence[str] = ()) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._stop = self._context.Event()
        self.all = [_Process(devices[-1 - place % len(devices)] if devices else "") for place in range(number)]

    def slots(self) -> int:
        return len(self.all)

    def submit(self, job: Job) -> Future[Any]:
        """Run a job in a free process, best in that of the latest job in its folder; in a new one
        where the latest job failed: no job is begun by a process of which something went wrong."""
        free = [each for each in self.all if not each.future or each.future.done()]
        process = next((each for each in free if each.folder == job.folder and not each.failed), free[0])
        process.folder = job.folder
        if process.executor and process.failed:
            process.executor.shutdown()
            process.executor = None
        process.executor = process.executor or ProcessPoolExecutor(
            1, self._context, initializer=_begin, initargs=(process.device, self._stop)
        )
        try:
            process.future = process.executor.submit(_work, job)
        except BrokenProcessPool as error:  # it was killed while it had no job
            process.future = Future()
            process.future.set_exception(error)
        return process.future

    def result(self, future: Future[Any]) -> tuple[Any, str]:
        device = next((each.device for each in self.all if each.future is future), "")
        try:
            return future.result(), f"{HERE}, device {device}" if device else HERE
        except BrokenProcessPool:
            raise Lost("its process was killed, or crashed") from None

    def close(self) -> None:
        self._stop.set()
        for process in self.all:
            if process.executor:
                process.executor.shutdown(cancel_futures=True)


def _begin(device: str, stop: Any) -> None:
    """Prepare a process of this machine, which ends with its parent: at once without a job, else as
    soon as that has saved its state."""
    if hasattr(os, "setsid"):
        os.setsid()  # Ctrl-C in the terminal reaches its parent alone, which sets `stop`
    if device:
        os.environ["CLSPLAT_DEVICE"] = device
    setattr(multiprocessing.current_process(), STOP, stop)

    def follow() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
        stop.set()
        _busy.acquire(timeout=GRACE_SECONDS)
        os._exit(INTERRUPTED)

    threading.Thread(target=follow, daemon=True).start()


def _work(job: Job) -> Any:
    """Run a job in a process of this machine; what it prints goes to its log."""
    with open(job.folder / LOG, "ab") as output:
        output.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} on {socket.gethostname()}: {job.name}\n".encode())
        for number in (1, 2):
            os.dup2(output.fileno(), number)
    stop = getattr(multiprocessing.current_process(), STOP)
    try:
        with _busy:
            return None if job.is_done else job.run(device_here(job.device, job.form), stopping=stop.is_set)
    except ClsplatError:
        raise
    except Exception as error:  # whose class may not be there, or not be pickled
        traceback.print_exc()
        raise RuntimeError(f"{type(error).__name__}: {line_of(error)} (see {job.folder / LOG})") from None


# `slots` jobs may run at a time; `submit` returns the future of one, and `result` what that job
# returned, and its worker, or raises what it raised, or Lost; `close` lets jobs save their state
_Pool = _InProcess | _Processes | Cluster
