"""When, by which version and by which command something was made, for its record."""

import shlex
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import clsplat

ENTRIES = ("clsplat", "clsplat.exe", "__main__.py")  # names of the program of the command line


def origin() -> dict[str, Any]:
    """The keys `version`, `commit`, `date` and `command`; a value that is unknown is None."""
    return {"version": clsplat.__version__, "commit": checkout_commit(),
            "date": datetime.now().astimezone().isoformat(timespec="seconds"),
            "command": command_line()}


def command_line() -> str | None:
    """The command that this process was started with, if it is one of clsplat; else None."""
    program = Path(sys.argv[0] if sys.argv else "")
    if program.name not in ENTRIES or program.name == ENTRIES[-1] and (
            program.parent != Path(clsplat.__file__).parent):
        return None
    return shlex.join(["clsplat", *sys.argv[1:]])


def checkout_commit() -> str | None:
    """The commit of the checkout that clsplat runs from, with -dirty if it was changed; else None.
    """
    root = Path(clsplat.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40",
             "--exclude=*"], check=False, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
