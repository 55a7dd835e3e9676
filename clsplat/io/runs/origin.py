"""Where something came from, for its record: version and command, and the place of its scene."""

import os
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import clsplat
from clsplat.errors import InputError


def origin() -> dict[str, Any]:
    """The keys `version`, `commit`, `date` and `command`; a value that is unknown is None."""
    return {
        "version": clsplat.__version__,
        "commit": checkout_commit(),
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": _command_line(),
    }


def _command_line() -> str | None:
    """The command that this process was started with, if it is one of clsplat."""
    program = Path(sys.argv[0] if sys.argv else "")
    is_ours = program.stem == "clsplat" or program.parent == Path(clsplat.__file__).parent
    return shlex.join(["clsplat", *sys.argv[1:]]) if is_ours else None


def checkout_commit() -> str | None:
    """The commit of the checkout that clsplat runs from, with -dirty if it was changed."""
    root = Path(clsplat.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            check=False,
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None


def scene_record(scene: Path, folder: Path) -> dict[str, str]:
    """Describe where a scene is, for a record in `folder`: "scene", relative to the folder, which
    stays right when both are moved together, and "scene_absolute"."""
    absolute = os.path.realpath(scene)
    try:
        relative = os.path.relpath(absolute, os.path.realpath(folder))
    except ValueError:  # another drive, on Windows
        relative = absolute
    return {"scene": Path(relative).as_posix(), "scene_absolute": absolute}


def recorded_scene(record: Mapping[str, Any], folder: Path, given: Path | None = None) -> Path:
    """Find the scene that `scene_record` described, or take the path that the user gives instead;
    InputError if it exists at neither recorded path."""
    if given is not None:
        return Path(given)
    named = [record[key] for key in ("scene", "scene_absolute") if record.get(key) and isinstance(record[key], str)]
    places = [Path(os.path.normpath(os.path.join(os.path.realpath(folder), name))) for name in named]
    for place in places:
        if place.exists():
            return place
    cause = f"its scene {places[-1]} no longer exists" if places else "it names no scene"
    raise InputError(
        f"{folder}: {cause}; say where it is, as SCENE to `clsplat train` and with --scene to other commands"
    )
