"""What a training tells of its progress to, where nobody wants to know."""


class Silent:
    """Takes everything that a progress line takes, and shows nothing."""

    def __call__(self, **told) -> None:
        """Numbers of a step."""

    def message(self, text: str) -> None:
        """A line that stays."""

    def phase(self, text: str) -> None:
        """What is being done now."""
