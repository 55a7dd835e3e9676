"""Where a run's or a city's scene is, when both may have been moved since."""

import os
from pathlib import Path
from urllib.parse import quote, unquote_to_bytes

from clsplat.errors import InputError

NOT_UTF8 = "bytes:"  # begins a path that is no Unicode text; the rest is percent-encoded


def scene_record(scene: Path, folder: Path) -> dict[str, str]:
    """What a record in `folder` says of where its scene is: {"scene": relative to the folder,
    "scene_absolute": the whole path}; the first holds when both are moved together."""
    absolute = os.path.realpath(scene)
    try:
        relative = os.path.relpath(absolute, os.path.realpath(folder))
    except ValueError:  # another drive, on Windows
        relative = absolute
    return {"scene": _text_of(Path(relative).as_posix()), "scene_absolute": _text_of(absolute)}


def recorded_scene(record: dict, folder: Path, given: Path | None = None) -> Path:
    """The path of a scene by what `scene_record` wrote, or `given`; InputError where it is gone."""
    if given is not None:
        return Path(given)
    named = [record[key] for key in ("scene", "scene_absolute")
             if record.get(key) and isinstance(record[key], str)]
    places = [Path(os.path.normpath(os.path.join(os.path.realpath(folder), _path_of(name))))
              for name in named]
    for place in places:
        if place.exists():
            return place
    where = f"its scene {places[-1]} is not there any more" if places else "it names no scene"
    raise InputError(f"{folder}: {where}; say where it is, as SCENE to `clsplat train` and "
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
