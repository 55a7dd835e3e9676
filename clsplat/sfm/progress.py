"""What the pipeline needs of a progress line."""

from typing import Protocol


class Progress(Protocol):
    """The methods of `clsplat.cli.progress.Progress` that are used here."""

    def count(self, what: str, done: int, total: int) -> None:
        """Show how many of `total` things are done."""

    def phase(self, text: str) -> None:
        """Show what is being done now."""

    def message(self, text: str) -> None:
        """Print a line that stays."""
