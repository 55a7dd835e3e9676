"""Where the scene of a run or a city is, when both may have been moved since."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clsplat.errors import InputError


def scene_record(scene: Path, folder: Path) -> dict[str, str]:
    """Describe where a scene is, for a record in `folder`: "scene", relative to the folder, which
    stays right when both are moved together, and "scene_absolute"; InputError if its path is not
    UTF-8."""
    absolute = os.path.realpath(scene)
    try:
        relative = os.path.relpath(absolute, os.path.realpath(folder))
    except ValueError:  # another drive, on Windows
        relative = absolute
    if absolute.encode(errors="replace").decode() != absolute:
        raise InputError(f"{scene}: its path is not UTF-8; rename its folder")
    return {"scene": Path(relative).as_posix(), "scene_absolute": absolute}


def recorded_scene(record: Mapping[str, Any], folder: Path, given: Path | None = None) -> Path:
    """Find the scene that `scene_record` described, or take the path that the user gives instead;
    InputError if it exists at neither recorded path."""
    if given is not None:
        return Path(given)
    named = [record[key] for key in ("scene", "scene_absolute")
             if record.get(key) and isinstance(record[key], str)]
    places = [Path(os.path.normpath(os.path.join(os.path.realpath(folder), name)))
              for name in named]
    for place in places:
        if place.exists():
            return place
    cause = f"its scene {places[-1]} no longer exists" if places else "it names no scene"
    raise InputError(f"{folder}: {cause}; say where it is, as SCENE to `clsplat train` and "
                     "with --scene to other commands")
