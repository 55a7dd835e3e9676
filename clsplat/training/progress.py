"""The interfaces of what shows a training to a user: a progress line, and a view of its model."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from clsplat.io.lock import note_work
from clsplat.schedule.plan import size_at

if TYPE_CHECKING:
    from clsplat.training.session import Session

WARNING = "warning: "  # begins a message that is always shown
NOTE_SECONDS = 10.0


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


class NotedProgress(SilentProgress):
    """Passes everything on to `shown`, and notes in a run's locked folder that its process does not
    hang."""

    def __init__(self, folder: Path, shown: SilentProgress) -> None:
        self._folder, self._shown, self._noted = folder, shown, time.monotonic()

    def __call__(self, **values: Any) -> None:
        self._note()
        self._shown(**values)

    def message(self, text: str) -> None:
        self._note()
        self._shown.message(text)

    def phase(self, text: str) -> None:
        self._note()
        self._shown.phase(text)

    def _note(self) -> None:
        if time.monotonic() - self._noted >= NOTE_SECONDS:
            self._noted = time.monotonic()
            note_work(self._folder)


class Watcher(Protocol):
    """Looks at a training between its steps; what it does is no part of the time of training."""

    def is_due(self) -> bool:
        """Whether `draw` is to be called now; must not wait."""

    def draw(self, session: Session) -> None:
        """Look at the model, and change nothing."""
