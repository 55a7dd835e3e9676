"""Finds the photos that a project of another program names, wherever they were moved."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path, PurePosixPath

from clsplat.errors import InputError
from clsplat.io.fields import CONTROL
from clsplat.io.reason import MOST_CHARACTERS
from clsplat.io.scenes.sources import PHOTO_SUFFIXES, photo_folder

SCHEME = "file://"


class PhotoFiles:
    """The photos of a project.

    Attributes
    ----------
    folder : of the photos: the one given as --images, else images/ of the project, else the
        project's own folder.
    """

    def __init__(self, project: Path, images: str = "") -> None:
        folder = photo_folder(project, images)
        self.folder = folder if images or folder.is_dir() else project
        self._given = bool(images)
        self._outside: dict[str, Path] = {}  # photos that are not below the folder, by their names

    def find(self, name: object, base: Path | None = None) -> tuple[str, Path]:
        """Find a photo.

        Parameters
        ----------
        name : as the project has it: a path of this or another machine, a file name, or a label
            without suffix.
        base : the folder to which a relative path refers, besides the folder of photos.

        Returns
        -------
        The name of its view, relative to the folder of photos or else with as many folders as
        distinguish it from others, and its path, which does not exist if no file fits.

        Raises
        ------
        ValueError : if the name is none, InputError if several files fit.
        """
        if not isinstance(name, str) or not name.strip() or CONTROL.search(name):
            raise ValueError("the name of a photo is not valid text")
        parts = self._parts(name)
        path = self._existing(parts, name, base) or self._below(parts)
        path = path or self.folder / parts[-1]
        # what is named ../other/a.jpg is not below the folder
        place, folder = (Path(os.path.normpath(each)) for each in (path, self.folder))
        if place.is_relative_to(folder):
            return place.relative_to(folder).as_posix(), path
        names = ("/".join(parts[number:]) for number in reversed(range(len(parts))))
        return next((short for short in names
                     if self._outside.setdefault(short, path) == path), name), path

    @staticmethod
    def _parts(name: str) -> list[str]:
        parts = PurePosixPath(name.removeprefix(SCHEME).replace("\\", "/")).parts
        kept = [part for part in parts if part not in ("/", "//", "..")]
        if not kept:
            raise ValueError(f"{name[:80]!r} is not the name of a photo")
        return kept

    def _existing(self, parts: list[str], name: str, base: Path | None) -> Path | None:
        """The file at the path itself, or at its end below the folder of photos."""
        places = [self.folder.joinpath(*parts[number:])
                  for number in range(len(parts))]
        if not self._given:  # a folder that the user gives holds all photos
            stored = Path(name.removeprefix(SCHEME))
            places += [base / stored if base else stored, stored]
        return next((place for place in places if os.path.isfile(place)), None)

    def _below(self, parts: list[str]) -> Path | None:
        """The only file of this name in folders of the photo folder; the suffix may be missing."""
        found = self._files.get(parts[-1].casefold(), [])
        if not found:
            return None
        if len(found) > 1:
            def shared(path: Path) -> int:
                own = [part.casefold() for part in path.parts[::-1]][1:]
                named = [part.casefold() for part in parts[::-1]][1:]
                equal = [a == b for a, b in zip(own, named)]
                return (equal + [False]).index(False)
            found = sorted(found, key=shared, reverse=True)
            if shared(found[0]) == shared(found[1]):
                raise InputError(f"{self.folder}: several photos fit {parts[-1][:80]!r}: "
                                 f"{_short(found[0])}, {_short(found[1])}; name the folder of the "
                                 "right ones with --images")
        return found[0]

    @cached_property
    def _files(self) -> dict[str, list[Path]]:
        """The photos below the folder, by file name and by stem, in lower case."""
        files: dict[str, list[Path]] = {}
        for path in _walk(self.folder):
            if path.suffix.lower() in PHOTO_SUFFIXES:
                for key in {path.name.casefold(), path.stem.casefold()}:
                    files.setdefault(key, []).append(path)
        return files


def check_present(sources: list[Path]) -> None:
    """InputError, with the cure, if photos are missing."""
    missing = [source for source in sources if not os.path.isfile(source)]
    if missing:
        raise InputError(f"{_short(missing[0])}: no such image ({len(missing)} of {len(sources)} "
                         "photos of the project are missing); put them there, or name their "
                         "folder with --images")


def _walk(folder: Path) -> Iterator[Path]:
    for place, folders, names in os.walk(folder):
        folders.sort()
        yield from (Path(place) / name for name in sorted(names))


def _short(path: Path) -> str:
    return str(path)[:MOST_CHARACTERS]
