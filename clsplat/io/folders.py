"""Folders that are created for written files, and links to files in them."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from clsplat.errors import InputError
from clsplat.io.atomic import PARTIAL

CURE = "check its path, and that the folder above may be written"


def make_folder(path: Path, cure: str = CURE) -> None:
    """Create a folder and its parents; InputError, with this cure, if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be created ({error.strerror}); {cure}") from None


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A folder beside `path` that becomes it when the block ends; if anything fails it is removed.
    InputError if `path` exists and is not an empty folder, or cannot be written."""
    partial = path.with_name(path.name + PARTIAL)
    if path.is_file() or path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: exists already; choose another folder, or remove this one")
    if partial.exists():
        raise InputError(f"{partial}: is left over from a command that was killed, or one writes it now; remove it")
    make_folder(partial)
    try:
        yield partial
        os.replace(partial, path)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError):
            raise InputError(f"{path}: cannot be written ({error.strerror}); {CURE}") from None
        raise


def link_file(source: Path, place: Path, kind: Literal["symbolic", "hard", "copy"] = "symbolic") -> None:
    """Link to a file from a place, whose folder is created, or copy it if the file system has no
    links; what is at the place stays. A hard link outlives its source."""
    make_folder(place.parent)
    source = source.resolve()
    if place.exists():
        return
    for link in {"symbolic": (os.symlink, os.link), "hard": (os.link,), "copy": ()}[kind]:
        with suppress(OSError):
            link(source, place)
            return
    partial = place.with_name(place.name + PARTIAL)
    shutil.copyfile(source, partial)
    os.replace(partial, place)
