"""The interfaces of what shows a training to a user: a progress line, and a view of its model."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

from clsplat.schedule.plan import size_at

if TYPE_CHECKING:
    from clsplat.training.session import Session

WARNING = "warning: "  # begins a message that is always shown


def training_at(level: float) -> str:
    """The phase of a training at a level."""
    return f"training at {size_at(level)}"


class SilentProgress:
    """Accepts everything that a progress line accepts, and shows only warnings."""

    def __call__(self, *, iteration: int, total: int, loss: float, gaussians: int,
                 memory_bytes: int, level: float) -> None:
        """Show the numbers of a training step."""

    def message(self, text: str) -> None:
        """Print a line that stays; here only a warning, to standard error if that is open."""
        if text.startswith(WARNING) and sys.stderr is not None:
            with suppress(OSError, ValueError):
                print(text, file=sys.stderr, flush=True)

    def phase(self, text: str) -> None:
        """Show what is being done now."""

    def count(self, what: str, done: int, total: int) -> None:
        """Show how many of `total` things are done."""


class Watcher(Protocol):
    """Looks at a training between its steps; what it does is no part of the time of training."""

    def is_due(self) -> bool:
        """Whether `draw` is to be called now; must not wait."""

    def draw(self, session: Session) -> None:
        """Look at the model, and change nothing."""
