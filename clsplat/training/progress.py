"""The interfaces of what shows a training to a user: a progress line, and a view of its model."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

from clsplat.schedule.plan import size_at

if TYPE_CHECKING:
    from clsplat.training.session import Session

WARNING = "warning: "  # begins a message that is always shown
BEGIN = "imports"  # of a process, before its first phase
SPENT = {  # beginning of a phase -> what its seconds are spent for
    "undistorting": "photos",
    "planning": "plan",
    "finding dense points": "dense points",
    "reading photos": "photos",
    "compiling": "kernels",
    "training": "steps",
    "evaluating": "evaluation",
    "writing the report": "report",
    "writing": "files",
}


def training_at(level: float) -> str:
    """The phase of a training at a level."""
    return f"training at {size_at(level)}"


class SilentProgress:
    """Accepts everything that a progress line accepts, and shows only warnings.

    Parameters
    ----------
    began : `time.perf_counter` when what the user waits for began; None: now.
    """

    def __init__(self, began: float | None = None) -> None:
        self._since = time.perf_counter() if began is None else began
        self._for, self._spent = BEGIN, dict[str, float]()

    def __call__(
        self, *, iteration: int, total: int, loss: float, gaussians: int, memory_bytes: int, level: float
    ) -> None:
        """Show the numbers of a training step."""

    def message(self, text: str) -> None:
        """Print a line that stays; here only a warning, to standard error if that is open."""
        if text.startswith(WARNING) and sys.stderr is not None:
            with suppress(OSError, ValueError):
                print(text, file=sys.stderr, flush=True)

    def phase(self, text: str) -> None:
        """Show what is being done now, from which on seconds are spent for it."""
        purpose = next((SPENT[begin] for begin in SPENT if text.startswith(begin)), self._for)
        if purpose != self._for:
            self.spent()
            self._for = purpose

    def spent(self) -> dict[str, float]:
        """What the seconds so far were spent for, in the order in which that began."""
        now = time.perf_counter()
        self._spent[self._for] = self._spent.get(self._for, 0.0) + now - self._since
        self._since = now
        return {purpose: round(seconds, 3) for purpose, seconds in self._spent.items()}

    def count(self, what: str, done: int, total: int) -> None:
        """Show how many of `total` things are done."""


class Watcher(Protocol):
    """Looks at a training between its steps; what it does is no part of the time of training."""

    def is_due(self) -> bool:
        """Whether `draw` is to be called now; must not wait."""

    def draw(self, session: Session) -> None:
        """Look at the model, and change nothing."""
