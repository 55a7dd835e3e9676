"""What a reconstruction keeps until it is finished, so that a killed one continues."""

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pycolmap

from clsplat.errors import InputError
from clsplat.io.photos.mask_files import MASKS
from clsplat.io.records import object_of, write_object
from clsplat.io.regular import read_regular
from clsplat.io.scenes.colmap import write_reconstruction
from clsplat.io.scenes.sources import IMAGES
from clsplat.sfm.mapping import Mapped
from clsplat.sfm.photos import UNFINISHED, SourcePhoto
from clsplat.sfm.video import DONE as FRAMES_DONE

STATE, MODEL, MAPPED = "state.json", "model", "mapped.json"


class Unfinished:
    """The folder .sfm of a scene.

    Attributes
    ----------
    folder : its path.
    database : of COLMAP: cameras, features and matches.
    frames : a folder, of a video.
    """

    def __init__(self, scene: Path) -> None:
        self.folder = scene / UNFINISHED
        self.database = self.folder / "database.db"
        self.frames = self.folder / "frames"

    @staticmethod
    def is_in(scene: Path) -> bool:
        """Whether a folder holds an unfinished reconstruction."""
        return (scene / UNFINISHED).is_dir()

    def open(self, photos: Sequence[SourcePhoto], options: dict[str, Any], overwrite: bool) -> bool:
        """Begin or continue a reconstruction; whether it continues.

        Parameters
        ----------
        options : that change the result of what is kept.
        overwrite : whether what other photos or options left may be removed.

        Raises
        ------
        InputError : the folder has what other photos or options left, or is damaged.
        """
        state = {"options": options, "photos": [
            [photo.name, photo.path.stat().st_size, str(photo.mask)] for photo in photos]}
        path = self.folder / STATE
        self.folder.mkdir(exist_ok=True)
        if path.exists():
            with suppress(OSError, ValueError):
                if object_of(read_regular(path)) == state:
                    return True
            if not overwrite:
                raise InputError(f"{self.folder.parent}: holds an unfinished reconstruction of "
                                 "other photos or with other options; give another folder, or "
                                 "--overwrite")
        # without a state, what is there was left by a command that was killed while it removed it
        self._forget()
        write_object(path, state)
        return False

    def _forget(self) -> None:
        """Remove everything but the frames of a video, the state first."""
        (self.folder / STATE).unlink(missing_ok=True)
        for path in self.folder.iterdir():
            if path.is_file() and path.name != FRAMES_DONE:
                path.unlink()
        shutil.rmtree(self.folder / MODEL, ignore_errors=True)
        for name in (IMAGES, MASKS, "sparse"):
            shutil.rmtree(self.folder.parent / name, ignore_errors=True)

    def mapped(self, compute: Callable[[], Mapped]) -> Mapped:
        """The reconstruction that is kept, or else the computed one, which is kept then."""
        kept, partial = self.folder / MODEL, self.folder / f"{MODEL}.part"
        if not kept.is_dir():
            result = compute()
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            write_reconstruction(partial, result.reconstruction)
            write_object(partial / MAPPED, {"method": result.method,
                                            "elsewhere": list(result.elsewhere)})
            partial.rename(kept)
        return self.kept()

    def kept(self) -> Mapped:
        """The reconstruction that `mapped` keeps."""
        kept = self.folder / MODEL
        record = object_of(read_regular(kept / MAPPED))
        return Mapped(pycolmap.Reconstruction(kept), record["method"], tuple(record["elsewhere"]))

    def remove(self) -> None:
        """Remove the folder, when the scene is complete."""
        shutil.rmtree(self.folder)
