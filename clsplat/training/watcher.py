"""Who may look at a training between its steps (clsplat/apps/live.py)."""

from __future__ import annotations

from typing import Protocol

from clsplat.training.session import Session


class Watcher(Protocol):
    """Is asked after every step; what it does is no part of the time of training."""

    def is_due(self) -> bool:
        """Whether `draw` is to be called now; must not wait."""

    def draw(self, session: Session) -> None:
        """Look at the model, and change nothing."""
