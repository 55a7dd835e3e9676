"""What a hostile case is: one shell line, as a user would type it, and what it must end with."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

WORKS, REFUSED, INTERRUPTED = 0, 2, 130
SECONDS = 60  # that a case may take on a machine that does nothing else


@dataclass(frozen=True)
class Result:
    """How a command ended: its exit code (None: it was killed after `seconds`) and its output."""

    code: int | None
    output: str
    seconds: float

    @property
    def errors(self) -> list[str]:
        """The lines that say what is wrong."""
        return [line for line in self.output.splitlines() if line.startswith("error: ")]


@dataclass(frozen=True)
class Case:
    """One row of the campaign.

    line: for bash, where `clsplat` is this checkout's; exits: the exit codes that are right;
    setup: a shell line or a function of the case's folder, before the command; needs: prepared
    inputs that are copied there; writes: files and folders that the command may change or make,
    everything else must stay as it is byte by byte; says and never: regular expressions that the
    output must and must not hold; checks: functions (folder, Result) -> what is wrong, or nothing;
    user: as whom; quick: also run by pytest.
    """

    name: str
    line: str
    exits: tuple[int, ...]
    setup: str | Callable[[Path], None] = ""
    needs: tuple[str, ...] = ("sy",)
    writes: tuple[str, ...] = ("out",)
    says: str = ""
    never: str = ""
    checks: tuple[Callable[[Path, Result], str | None], ...] = ()
    environment: dict[str, str] = field(default_factory=dict)
    seconds: float = SECONDS
    quick: bool = False


def works(name: str, line: str, *checks, **more) -> Case:
    """A case that must succeed."""
    return Case(name, line, (WORKS,), checks=checks, **more)


def refused(name: str, line: str, says: str = "", *checks, **more) -> Case:
    """A case that must be refused with one line; says: what that line must name."""
    return Case(name, line, (REFUSED,), says=says, checks=checks, **more)


def either(name: str, line: str, *checks, **more) -> Case:
    """A case that may work or be refused, but neither break nor lose anything."""
    return Case(name, line, (WORKS, REFUSED), checks=checks, **more)


def interrupted(name: str, line: str, *checks, **more) -> Case:
    """A case that must end as after Ctrl-C."""
    return Case(name, line, (INTERRUPTED,), checks=checks, **more)
