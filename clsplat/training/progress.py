"""The interface of a progress line, which shows nothing."""

import sys
from contextlib import suppress

WARNING = "warning: "  # begins a message that is always shown


class SilentProgress:
    """Accepts everything that a progress line accepts, and shows only warnings."""

    def __call__(self, **values: object) -> None:
        """Show values of a step."""

    def message(self, text: str) -> None:
        """Print a line that stays; here only a warning, to standard error if that is open."""
        if text.startswith(WARNING) and sys.stderr is not None:
            with suppress(OSError, ValueError):
                print(text, file=sys.stderr, flush=True)

    def phase(self, text: str) -> None:
        """Show what is being done now."""
