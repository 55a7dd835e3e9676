"""Runs jobs in this process, in processes of this machine, or on a Dask cluster.

Executors of `concurrent.futures` and a client of `distributed` run them alike, as their futures
have one protocol. A worker that dies is replaced.
"""

from __future__ import annotations

import _thread
import logging
import multiprocessing
import os
import signal
import socket
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from clsplat.cities.cluster import Cluster
from clsplat.cities.jobs import GRACE_SECONDS, HERE, Job, Lost, Unfit, device_here, line_of
from clsplat.errors import ClsplatError, InputError, Interrupted
from clsplat.io.folders import make_folder
from clsplat.io.lock import LockTaken
from clsplat.training.interrupt import handled_interrupts, was_interrupted

MOST_WORKERS = 1024  # of one machine
RETRIES = 2  # of a job that fails, unless its input is invalid
MOST_LOSSES = 10  # workers that may disappear while they run a job: it may be the cause
POLL_SECONDS = 0.05
LOG = "log.txt"  # in a job's folder: what its processes print
INTERRUPTED = 130  # exit code

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """The end of a job.

    Attributes
    ----------
    job, worker : the job, and the last one that ran it.
    value : what it returned; None if it was finished before, or failed.
    error : why it failed; None: it did not.
    seconds, tries : the duration of all its tries, and how many there were.
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


class Pool(Protocol):
    """Where jobs run."""

    def slots(self) -> int:
        """How many jobs may run at the same time."""

    def submit(self, job: Job) -> Any:
        """Start a job, and return its future; called while a slot is free."""

    def result(self, future: Any) -> tuple[Any, str]:
        """What the job of a future returned, and its worker; raises what it raised, or Lost."""

    def close(self) -> None:
        """Let running jobs save their state, and end."""


class Workers:
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
            raise InputError(f"--workers {number}: expects 1 to {MOST_WORKERS}, as many as this "
                             "machine has free devices or cores")
        self.number, self.scheduler, self.devices = number, scheduler, tuple(devices)
        self._pool: Pool | None = None

    @property
    def several(self) -> bool:
        """Whether jobs run in other processes."""
        return self.number > 1 or bool(self.scheduler)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def run(self, jobs: Sequence[Job], here: Callable[[Any], Any],
            began: Callable[[Any], object] | None = None,
            ended: Callable[[Outcome], object] | None = None, retries: int = RETRIES
            ) -> list[Outcome]:
        """Run jobs, the first ones first, until each is finished or has failed.

        Parameters
        ----------
        here : runs a job in this process, if there are no other ones.
        began, ended : called with each job that begins, and with each Outcome.
        retries : how often a job that fails is tried again, unless its input is invalid.

        Returns
        -------
        The Outcome of each job, in the order of the jobs.

        Raises
        ------
        Interrupted : on Ctrl-C; running jobs are told to save their state and end.
        InputError : the cluster cannot be used.
        """
        board = _Board(jobs, retries, ended)
        if not board.waiting:
            return board.all_outcomes()
        if self.several and not self._pool:
            self._pool = (Cluster(self.scheduler) if self.scheduler else
                          _Processes(self.number, self.devices))
        pool: Pool = self._pool or _InProcess(here)
        running: dict[Any, Job] = {}
        try:
            while running or board.can_begin:
                while len(running) < pool.slots() and (job := board.next_job()):
                    if began:
                        began(job)
                    running[pool.submit(job)] = job
                done = [future for future in running if future.done()]
                for future in done:
                    board.settle(running.pop(future), future, pool)
                if not done:
                    time.sleep(POLL_SECONDS)
        except KeyboardInterrupt:
            self.close()
            raise Interrupted(
                f"stopped, {len(board.outcomes)} of {len(board.jobs)} jobs finished; the running "
                "ones save their state, and the same command continues them") from None
        return board.all_outcomes()

    def close(self) -> None:
        """End the processes; those that work save their state before."""
        if self._pool:
            self._pool.close()
            self._pool = None


class _Board:
    """Which jobs wait, how often each was tried, and how it ended; arguments as for `run`.

    Jobs that were finished before get an Outcome without tries, which is not reported. The folders
    of the other ones are created.
    """

    def __init__(self, jobs: Sequence[Job], retries: int,
                 ended: Callable[[Outcome], object] | None) -> None:
        self.jobs, self._retries, self._ended = list(jobs), retries, ended
        self.outcomes = {job.name: Outcome(job) for job in self.jobs if job.is_done}
        self.waiting = deque(job for job in self.jobs if job.name not in self.outcomes)
        self._tries, self._failures, self._losses = (Counter[str]() for _ in range(3))
        self._seconds, self._began = dict[str, float](), dict[str, float]()
        for job in self.waiting:
            make_folder(job.folder)

    @property
    def can_begin(self) -> bool:
        """Whether a waiting job may begin."""
        return any(not self._awaited(job) for job in self.waiting)

    def next_job(self) -> Job | None:
        """Take the first of the waiting jobs that may begin; None if there is none."""
        job = next((job for job in self.waiting if not self._awaited(job)), None)
        if job:
            self.waiting.remove(job)
            self._tries[job.name] += 1
            self._began[job.name] = time.monotonic()
        return job

    def settle(self, job: Job, future: Any, pool: Pool) -> None:
        """Note the end of a try: the job is finished, has finally failed, or waits again."""
        name, error, value, worker = job.name, None, None, HERE
        self._seconds[name] = (self._seconds.get(name, 0.0) + time.monotonic()
                               - self._began[name])
        try:
            value, worker = pool.result(future)
            if job.done and not job.is_done:
                raise RuntimeError(f"it ended without an error but did not write {job.done}")
        except Exception as raised:  # noqa: BLE001  (another machine may raise anything)
            error = raised
            lost = isinstance(raised, (Lost, Unfit, Interrupted))
            refused = isinstance(raised, ClsplatError) and not isinstance(raised, LockTaken)
            (self._losses if lost else self._failures)[name] += 1
            if self._losses[name] < MOST_LOSSES and (
                    lost or not refused and self._failures[name] <= self._retries):
                self.waiting.append(job)
                return
        self.outcomes[name] = outcome = Outcome(job, value, error, self._seconds[name],
                                                self._tries[name], worker)
        if self._ended:
            self._ended(outcome)

    def all_outcomes(self) -> list[Outcome]:
        """Those of all jobs, in their order; of one that still waits, for which job."""
        return [self.outcomes.get(job.name) or Outcome(job, error=InputError(
            f"it waits for {self._awaited(job)}")) for job in self.jobs]

    def _awaited(self, job: Job) -> str:
        """The first job that must be finished before this one, and is not; "" if there is none."""
        return next((name for name in job.after
                     if name not in self.outcomes or not self.outcomes[name].ok), "")


class _InProcess:
    """A Pool that runs one job at a time, in the thread that receives Ctrl-C."""

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


class _Process:
    """A process of this machine, which is replaced after a job that fails: no job is begun by a
    process of which something went wrong. `device` : its CLSPLAT_DEVICE; "" for that of this one.
    """

    def __init__(self, device: str = "") -> None:
        self.device = device
        self._executor: ProcessPoolExecutor | None = None
        self._pid: Future[int] = Future()
        self.future: Future[Any] | None = None  # of its latest job

    @property
    def is_free(self) -> bool:
        return self.future is None or self.future.done()

    def submit(self, job: Job) -> Future[Any]:
        """Run a job, in a new process if there is none, or the latest job failed."""
        if self.future and self.future.exception():
            self.close()
        try:
            self.future = (self._executor or self._start()).submit(_work, job)
        except BrokenProcessPool:  # it was killed while it had no job
            self.future = self._start().submit(_work, job)
        return self.future

    def _start(self) -> ProcessPoolExecutor:
        self._executor = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"),
                                             initializer=_begin, initargs=(self.device,))
        self._pid = self._executor.submit(os.getpid)
        return self._executor

    def interrupt(self) -> None:
        """Let it save its state, and end."""
        if self._executor and self._pid.done() and not self._pid.exception() and not self.is_free:
            with suppress(OSError):
                os.kill(self._pid.result(), signal.SIGINT)

    def close(self) -> None:
        """Wait until it has saved its state, if it works, and end it."""
        if not self._executor:
            return
        if self.future and not self.is_free:
            with suppress(Exception):
                self.future.exception(GRACE_SECONDS)
            if not self.is_free:
                with suppress(OSError):
                    os.kill(self._pid.result(), getattr(signal, "SIGKILL", signal.SIGTERM))
        self._executor.shutdown(cancel_futures=True)
        self._executor = self.future = None


class _Processes:
    """A Pool of processes of this machine; `number`, `devices` as for `Workers`."""

    def __init__(self, number: int, devices: Sequence[str] = ()) -> None:
        self.all = [_Process(devices[-1 - place % len(devices)] if devices else "")
                    for place in range(number)]

    def slots(self) -> int:
        return len(self.all)

    def submit(self, job: Job) -> Future[Any]:
        return next(process for process in self.all if process.is_free).submit(job)

    def result(self, future: Future[Any]) -> tuple[Any, str]:
        try:
            device = next((each.device for each in self.all if each.future is future), "")
            return future.result(), f"{HERE}, device {device}" if device else HERE
        except BrokenProcessPool:
            raise RuntimeError("its process was killed, or crashed") from None

    def close(self) -> None:
        for process in self.all:
            process.interrupt()
        for process in self.all:
            process.close()


def _begin(device: str) -> None:
    """Prepare a process of this machine.

    It ignores Ctrl-C in the terminal, which its parent passes on once, and ends with its parent: at
    once without a job, else as soon as that has saved its state.
    """
    if hasattr(os, "setsid"):
        os.setsid()
    signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    if device:
        os.environ["CLSPLAT_DEVICE"] = device
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent:
            parent.join()
        main_thread = threading.main_thread().ident
        if hasattr(signal, "pthread_kill") and main_thread is not None:  # it ends a system call
            signal.pthread_kill(main_thread, signal.SIGINT)
        else:  # Windows
            _thread.interrupt_main()
        time.sleep(GRACE_SECONDS)
        os._exit(INTERRUPTED)

    threading.Thread(target=follow, daemon=True).start()


def _work(job: Job) -> Any:
    """Run a job in a process of this machine; what it prints goes to its log."""
    with open(job.folder / LOG, "ab") as output:
        output.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} on {socket.gethostname()}: "
                     f"{job.name}\n".encode())
        for number in (1, 2):
            os.dup2(output.fileno(), number)
    with handled_interrupts():
        try:
            return None if job.is_done else job.run(device_here(job.device, job.form))
        except ClsplatError:
            raise
        except KeyboardInterrupt:
            raise Interrupted("it was stopped") from None
        except Exception as error:  # whose class may not be there, or not be pickled
            if was_interrupted(error):
                raise Interrupted("it was stopped") from None
            traceback.print_exc()
            raise RuntimeError(f"{type(error).__name__}: {line_of(error)} (see {job.folder / LOG})"
                               ) from None
        finally:
            parent = multiprocessing.parent_process()
            if parent and not parent.is_alive():  # nobody waits for the result
                os._exit(INTERRUPTED)
