"""Pools on this machine: one job at a time in this process, or one in each of several processes."""

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
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any

from clsplat.cities.jobs import GRACE_SECONDS, HERE, Job, device_here, line_of
from clsplat.errors import ClsplatError, Interrupted
from clsplat.training.interrupt import handled_interrupts, was_interrupted

LOG = "log.txt"  # in a job's folder: what its processes print
INTERRUPTED = 130  # exit code

log = logging.getLogger(__name__)


class InProcess:
    """A Pool that runs one job at a time, in the thread that receives Ctrl-C."""

    def __init__(self, call: Callable[[Any], Any]) -> None:
        self._call = call

    def slots(self) -> int:
        """One."""
        return 1

    def submit(self, job: Job) -> Future[Any]:
        """Run the job to its end."""
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
        """What the job returned."""
        return future.result(), HERE

    def close(self) -> None:
        """Nothing is running."""


class Process:
    """A process of this machine, which is replaced after a job that fails: no job is begun by a
    process of which something went wrong.

    Parameters
    ----------
    device : its CLSPLAT_DEVICE; "" for that of this process.
    """

    def __init__(self, device: str = "") -> None:
        self.device = device
        self._executor: ProcessPoolExecutor | None = None
        self._pid: Future[int] = Future()
        self.future: Future[Any] | None = None  # of its latest job

    @property
    def is_free(self) -> bool:
        """Whether it has no job."""
        return self.future is None or self.future.done()

    def _start(self) -> ProcessPoolExecutor:
        self._executor = started = ProcessPoolExecutor(
            1, multiprocessing.get_context("spawn"), initializer=_begin, initargs=(self.device,))
        self._pid = started.submit(os.getpid)
        return started

    def submit(self, job: Job) -> Future[Any]:
        """Run a job, in a new process if there is none, or the latest job failed."""
        if self.future and self.future.exception():
            self.close()
        try:
            self.future = (self._executor or self._start()).submit(_work, job)
        except BrokenProcessPool:  # it was killed while it had no job
            self.future = self._start().submit(_work, job)
        return self.future

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
        self._executor.shutdown(wait=False, cancel_futures=True)
        self._executor = self.future = None


class Processes:
    """A Pool of processes of this machine.

    Parameters
    ----------
    number, devices : as for `Workers`.
    """

    def __init__(self, number: int, devices: Sequence[str] = ()) -> None:
        self.all = [Process(devices[-1 - place % len(devices)] if devices else "")
                    for place in range(number)]

    def slots(self) -> int:
        """The number of processes."""
        return len(self.all)

    def submit(self, job: Job) -> Future[Any]:
        """Run the job in a process that has none."""
        return next(process for process in self.all if process.is_free).submit(job)

    def result(self, future: Future[Any]) -> tuple[Any, str]:
        """What the job returned."""
        try:
            device = next((each.device for each in self.all if each.future is future), "")
            return future.result(), f"{HERE}, device {device}" if device else HERE
        except BrokenProcessPool:
            raise RuntimeError("its process was killed, or crashed") from None

    def close(self) -> None:
        """End the processes; those that work save their state before."""
        for process in self.all:
            process.interrupt()
        for process in self.all:
            process.close()


# --- in a process


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
