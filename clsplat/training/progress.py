"""What a training tells of its progress to, where nobody wants to know."""

import sys
from contextlib import suppress

WARNING = "warning: "  # begins a message that is shown nevertheless

class SilentProgress:
    """Takes everything that a progress line takes, and shows nothing but warnings."""

    def __call__(self, **told) -> None:
        """Numbers of a step."""

    def message(self, text: str) -> None:
        """A line that stays; a warning goes to standard error, if anybody can still read it."""
        if text.startswith(WARNING) and sys.stderr is not None:
            with suppress(OSError, ValueError):
                print(text, file=sys.stderr, flush=True)

    def phase(self, text: str) -> None:
        """What is being done now."""
