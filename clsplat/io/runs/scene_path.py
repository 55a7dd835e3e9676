"""Where the scene of a run or a city is, when both may have been moved since."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote_to_bytes

from clsplat.errors import InputError

NOT_UTF8 = "bytes:"  # begins a path that is not Unicode text; the rest is percent-encoded


def scene_record(scene: Path, folder: Path) -> dict[str, str]:
    """Describe where a scene is, for a record in `folder`: "scene", relative to the folder, which
    stays right when both are moved together, and "scene_absolute"."""
    absolute = os.path.realpath(scene)
    try:
        relative = os.path.relpath(absolute, os.path.realpath(folder))
    except ValueError:  # another drive, on Windows
        relative = absolute
    return {"scene": _text_of(Path(relative).as_posix()), "scene_absolute": _text_of(absolute)}


def recorded_scene(record: Mapping[str, Any], folder: Path, given: Path | None = None) -> Path:
    """Find the scene that `scene_record` described, or take the path that the user gives instead;
    InputError if it exists at neither recorded path."""
    if given is not None:
        return Path(given)
    named = [record[key] for key in ("scene", "scene_absolute")
             if record.get(key) and isinstance(record[key], str)]
    places = [Path(os.path.normpath(os.path.join(os.path.realpath(folder), _path_of(name))))
              for name in named]
    for place in places:
        if place.exists():
            return place
    cause = f"its scene {places[-1]} no longer exists" if places else "it names no scene"
    raise InputError(f"{folder}: {cause}; say where it is, as SCENE to `clsplat train` and "
                     "with --scene to other commands")


def _text_of(path: str) -> str:
    try:
        path.encode()
        return path
    except UnicodeEncodeError:
        return NOT_UTF8 + quote(os.fsencode(path))


def _path_of(text: str) -> str:
    if text.startswith(NOT_UTF8):
        return os.fsdecode(unquote_to_bytes(text[len(NOT_UTF8):]))
    return text
