"""Pools on this machine: one task at a time in this process, or several in child processes."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import replace
from queue import LifoQueue

from clsplat.distribute.child import Child
from clsplat.distribute.task import DONE, FAILED, REFUSED, Result, Task
from clsplat.errors import ClsplatError, Interrupted
from clsplat.io.lock import exclusive
from clsplat.training.interrupt import was_interrupted

HERE = "this machine"


class InProcess:
    """A Pool that calls a function for one task at a time, in the thread that receives Ctrl-C."""

    def __init__(self, began: Callable[[str], object], call: Callable[[Task], object]) -> None:
        self._began, self._call = began, call

    def slots(self) -> int:
        """One."""
        return 1

    def submit(self, task: Task) -> Future[Result]:
        """Run the task to its end."""
        self._began(task.name)
        start = time.monotonic()
        ending, message = self._ending(task)
        future: Future[Result] = Future()
        future.set_result(Result(ending, message, time.monotonic() - start, HERE))
        return future

    def _ending(self, task: Task) -> tuple[str, str]:
        """Run the task; how it ended, and the message of its Result."""
        try:
            with exclusive(task.folder):
                if not task.done.exists():
                    self._call(task)
        except Interrupted:
            raise
        except ClsplatError as error:
            return REFUSED, str(error)
        except Exception as error:  # noqa: BLE001  (the other tasks are still run)
            if was_interrupted(error):
                raise KeyboardInterrupt from None
            logging.getLogger(__name__).exception("%s failed", task.name)
            return FAILED, f"{type(error).__name__}: {error}"
        if not task.done.exists():
            return FAILED, f"it ended without an error but did not write {task.done}"
        return DONE, ""

    def finished(self, futures: Collection[Future[Result]]) -> list[tuple[Future[Result], Result]]:
        """All of them."""
        return [(future, future.result()) for future in futures]

    def close(self) -> None:
        """Nothing is running."""


class Children:
    """Child processes on this machine, which serve one `run` after the other; as a context, they
    end with it.

    Parameters
    ----------
    number : how many.
    devices : values of CLSPLAT_DEVICE that they use in turn, from the last one, as a process that
        works on a device itself uses the first one.
    needed : MODULE or MODULE:CALL:ARG... that they import and call at once (guarded.py),
        so that they are ready when tasks come; at most as many are started before as the machine
        has cores. None: each is started for its first task.

    Attributes
    ----------
    free : those that have no task; the next task gets the one on top, which has been started.
    """

    def __init__(self, number: int, devices: Sequence[str] = (), needed: Sequence[str] = ()
                 ) -> None:
        self._children = [Child(devices[-1 - place % len(devices)] if devices else "")
                          for place in range(number)]
        self.free: LifoQueue[Child] = LifoQueue()
        for child in reversed(self._children):
            self.free.put(child)
        for child in self._children[:(os.cpu_count() or 1) if needed else 0]:
            with suppress(OSError):  # its first task will tell that no process can be started
                child.start(needed)

    def __len__(self) -> int:
        return len(self._children)

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def work(self, task: Task, program: str, stopping: Callable[[], bool] = lambda: False
             ) -> Result:
        """Try a task as soon as a child is free; for the parameters see `Child.work`."""
        child = self.free.get()
        try:
            result = child.work(task, program, stopping)
            return replace(result, worker=f"{HERE}, device {child.device}" if child.device
                           else HERE)
        finally:
            self.free.put(child)

    def end(self) -> None:
        """Tell the processes to end, as there will be no more tasks."""
        for child in self._children:
            child.end()

    def close(self) -> None:
        """Tell the processes to end, and wait for that."""
        self.end()
        for child in self._children:
            child.close()


class Processes:
    """A Pool of child processes on this machine."""

    def __init__(self, began: Callable[[str], object], children: Children, program: str) -> None:
        self._began, self._children, self._program = began, children, program
        self._threads = ThreadPoolExecutor(len(children))
        self._stopping = threading.Event()

    def slots(self) -> int:
        """The number of children."""
        return len(self._children)

    def submit(self, task: Task) -> Future[Result]:
        """Run the task in a child as soon as one is free."""
        return self._threads.submit(self._work, task)

    def _work(self, task: Task) -> Result:
        self._began(task.name)
        return self._children.work(task, self._program, self._stopping.is_set)

    def finished(self, futures: Collection[Future[Result]]) -> list[tuple[Future[Result], Result]]:
        """Wait for the first of the futures, and return those that ended."""
        done, _ = wait(futures, return_when=FIRST_COMPLETED)
        return [(future, future.result()) for future in done]

    def close(self) -> None:
        """Tell the children that work on a task to save their state, and wait until they ended."""
        self._stopping.set()
        self._threads.shutdown(cancel_futures=True)
