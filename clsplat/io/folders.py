"""Folders that are created for written files, and removed when they are empty."""

from contextlib import suppress
from pathlib import Path

from clsplat.errors import InputError

CURE = "check its path, and that the folder above may be written"


def make_folder(path: Path, cure: str = CURE) -> None:
    """Create a folder and its parents; InputError, with this cure, if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be created ({error.strerror}); {cure}") from None


def remove_files(paths: list[Path], root: Path) -> None:
    """Remove files below `root`, then the folders that this leaves empty, `root` included."""
    for path in paths:
        path.unlink(missing_ok=True)
        folder = path.parent
        with suppress(OSError):  # not empty: it stays
            while folder.is_relative_to(root):
                folder.rmdir()
                folder = folder.parent
