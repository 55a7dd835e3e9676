"""The commit of a checkout, for the record of a run."""

import subprocess
from pathlib import Path

import clsplat


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
