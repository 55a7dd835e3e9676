"""What the pipeline needs of a progress line."""

from typing import Protocol


class Progress(Protocol):
    """The part of `clsplat.cli.progress.Progress` that is used here."""

    def count(self, what: str, done: int, total: int) -> None:
        """Show how many of `total` things are done."""

    def phase(self, text: str) -> None:
        """Show what is being done now."""

    def message(self, text: str) -> None:
        """Print a line that stays."""


class Silent:
    """Shows nothing."""

    def count(self, what: str, done: int, total: int) -> None:
        """Ignore a count."""

    def phase(self, text: str) -> None:
        """Ignore a phase."""

    def message(self, text: str) -> None:
        """Ignore a message."""
