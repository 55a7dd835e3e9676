"""What is sent to workers, what they return, and what a pool of workers does."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

# how a try of a task may end
DONE = "done"
FAILED = "failed"  # it is tried again
REFUSED = "refused"  # its input is invalid, so that it is not tried again
UNFIT = "unfit"  # the worker cannot run it, another worker may
LOST = "lost"  # the worker has disappeared, or was stopped

# exit codes of children
INPUT, LOCKED, INTERRUPTED, TERMINATED = 2, 75, 130, 143
QUIET_SECONDS = 600  # until a warning, and between two
HANG_SECONDS = 3600  # without a change in its folder, after which a child is ended
LOG = "log.txt"  # in the task's folder: the output of all tries in child processes
GRACE_SECONDS = 120  # for an interrupted child to save its state


@dataclass(frozen=True)
class Task:
    """A command of clsplat.

    Attributes
    ----------
    name : differs from those of the other tasks.
    command : the arguments of `clsplat`.
    done : a file that exists once the task is finished, in a folder that no other task uses at the
        same time.
    after : names of tasks that must be finished before this one begins.
    """

    name: str
    command: tuple[str, ...]
    done: Path
    after: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """The folder of the task's lock and log."""
        return Path(self.done).parent


@dataclass(frozen=True)
class Result:
    """The result of one try of a task.

    Attributes
    ----------
    ending : DONE, FAILED, REFUSED, UNFIT or LOST.
    message : one line with the cause, "" if the task is done.
    seconds : the duration of the try.
    worker : the worker that tried.
    """

    ending: str
    message: str = ""
    seconds: float = 0.0
    worker: str = ""


@dataclass(frozen=True)
class Outcome:
    """The final result of a task.

    Attributes
    ----------
    task : the task.
    ok : whether it is finished.
    seconds : the duration of all its tries that ended.
    tries : how many tries this `run` started.
    worker : the last worker.
    message : one line with the cause of a failure.
    """

    task: Task
    ok: bool
    seconds: float
    tries: int
    worker: str
    message: str


class Pool(Protocol):
    """Workers that run tasks."""

    def slots(self) -> int:
        """How many tasks may run at the same time."""

    def submit(self, task: Task) -> Any:
        """Start a task, and return its future."""

    def finished(self, futures: Collection[Any]) -> list[tuple[Any, Result]]:
        """Wait for some of the futures, and return those that ended with their results."""

    def close(self) -> None:
        """Stop the running tasks, and release the workers."""
