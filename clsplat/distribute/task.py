"""What travels to workers, and what comes back."""

from dataclasses import dataclass
from pathlib import Path

# how a try of a task may end
DONE = "done"
FAILED = "failed"  # worth another try
REFUSED = "refused"  # its input is bad, and will be
UNFIT = "unfit"  # the worker is at fault: another will do
LOST = "lost"  # the worker is gone, or was stopped

# exit codes of children
INPUT, HELD, INTERRUPTED, TERMINATED = 2, 75, 130, 143
GRACE_SECONDS = 120  # that an interrupted child has for saving its state


@dataclass(frozen=True)
class Task:
    """name: unique; command: what follows `clsplat`; done: path that exists once it is finished, in
    a folder in which nothing else is."""

    name: str
    command: tuple[str, ...]
    done: Path

    @property
    def folder(self):
        """Where its lock and its log are."""
        return Path(self.done).parent


@dataclass(frozen=True)
class Result:
    """One try. ending: one of the above; seconds: it took; worker: who tried."""

    ending: str
    message: str = ""
    seconds: float = 0.0
    worker: str = ""


@dataclass(frozen=True)
class Outcome:
    """What became of a task. seconds: of its tries that came to an end; tries: begun, by this
    `run`; worker: the last; message: one line, why it failed."""

    task: Task
    ok: bool
    seconds: float
    tries: int
    worker: str
    message: str
