"""The pictures of a run, renders/KIND/NAME.png: those that clsplat wrote may be replaced."""

import os
from pathlib import Path

from clsplat.errors import InputError
from clsplat.io.folders import make_folder, remove_files
from clsplat.io.records import object_of, write_object

RENDERS = "renders"
WRITTEN = "written.json"  # in that folder: the pictures there that clsplat wrote


class Renders:
    """The pictures of views in the render folder of a run."""

    def __init__(self, run: Path) -> None:
        self.folder = run / RENDERS

    def paths(self) -> list[Path]:
        """The pictures that clsplat wrote and that still exist; those behind a link are left out,
        since they may belong to somebody else."""
        try:
            names = object_of((self.folder / WRITTEN).read_bytes())["pictures"]
            paths = [self.folder / name for name in names if ".." not in Path(name).parts]
        except (OSError, ValueError, KeyError, TypeError):
            return []
        inside = os.path.join(os.path.realpath(self.folder.parent), RENDERS, "")
        return [path for path in paths if path.is_file() and not path.is_symlink()
                and os.path.realpath(path).startswith(inside)]

    def note(self, kind: str, names: list[str]) -> None:
        """Record that each `path(kind, name)` will be written: --overwrite may remove it."""
        make_folder(self.folder)
        pictures = {path.relative_to(self.folder).as_posix() for path in self.paths()}
        pictures |= {f"{kind}/{name}.png" for name in names}
        write_object(self.folder / WRITTEN, {"pictures": sorted(pictures)}, indent=0)

    def path(self, kind: str, name: str) -> Path:
        """Where to write the picture of a view; its folder is created.

        The suffix of the view's name is kept, or a.jpg and a.png would share one file.
        """
        path = self.folder / kind / f"{name}.png"
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise InputError(f"{name}: a view's name must not leave the render folder; rename it")
        make_folder(path.parent)
        return path

    def remove(self) -> None:
        """Remove what clsplat wrote; a render folder that is a link is not followed."""
        if not self.folder.is_symlink():
            remove_files([*self.paths(), self.folder / WRITTEN], self.folder)
