"""The files of masks, by the names that other programs give them.

| program | mask of a/b.jpg |
|---|---|
| COLMAP, Meshroom, this one | masks/a/b.jpg.png, masks/a/b.png |
| OpenDroneMap, Metashape, OpenMVS | a/b_mask.jpg, a/b_mask.png |
| RealityScan | a/b.jpg.mask.png, a/.mask/b.png |
| others | masks/, mask/, ... in the folder of the photos or beside it, with the name of the photo |

All of them are dark where the photo does not count.
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from clsplat.io.scenes.sources import PHOTO_SUFFIXES

MASKS = "masks"
FOLDERS = (MASKS, "mask", "image_masks", "images_mask", "images_masks", ".mask")
MARKED = re.compile(r"(.+)(?:_mask|\.mask)", re.IGNORECASE)  # a name without its suffix


def photo_of(name: str) -> str:
    """The name or the stem of the photo to which a mask belongs that is named as one; "" if the
    name is not that of a mask."""
    path = PurePosixPath(name)
    found = MARKED.fullmatch(path.stem) if path.suffix.lower() in PHOTO_SUFFIXES else None
    return found[1] if found else ""


def mask_folders(folder: Path) -> list[Path]:
    """The folders of a folder that are named as those of masks."""
    return [folder / name for name in FOLDERS if (folder / name).is_dir()]


class MaskFiles:
    """Finds the masks of photos.

    Parameters
    ----------
    folders : of masks, in which they have the names of photos.
    beside : whether masks are also searched beside each photo, and in folders beside it.

    Attributes
    ----------
    used : masks that were found.
    """

    def __init__(self, folders: Iterable[Path], beside: bool = True) -> None:
        self._folders, self._beside = tuple(folders), beside
        self._known: dict[tuple[Path, bool], dict[str, Path]] = {}
        self.used: set[Path] = set()

    def of(self, name: str, photo: Path | None = None) -> Path | None:
        """The mask of a photo; None: it has none.

        Parameters
        ----------
        name : of the photo below the folders, with slashes.
        photo : its file.
        """
        relative = Path(name)
        places = [((folder / relative).parent, False) for folder in self._folders]
        if photo is not None and self._beside:
            places.append((photo.parent, True))
            places += [((above / folder / photo.relative_to(above)).parent, False)
                       for above in photo.parents[:len(relative.parts)] for folder in FOLDERS]
        names = [relative.name] if photo is None else [relative.name, photo.name]
        for place in places:
            found = self._files(*place)
            for each in names:
                mask = found.get(each) or found.get(PurePosixPath(each).stem)
                if mask and not (photo and os.path.samefile(mask, photo)):
                    self.used.add(mask)
                    return mask
        return None

    def _files(self, folder: Path, only_marked: bool) -> dict[str, Path]:
        """The masks of a folder, by the names or the stems of photos."""
        if (folder, only_marked) not in self._known:
            found: dict[str, Path] = {}
            names = os.listdir(folder) if folder.is_dir() else []
            # in the format that most have, if there are several
            for name in sorted(names, key=lambda name: (not name.endswith(".png"), name)):
                path = PurePosixPath(name)
                if path.suffix.lower() not in PHOTO_SUFFIXES:
                    continue
                marked = photo_of(name)
                for key in [marked] if marked else [] if only_marked else [path.stem, name]:
                    found.setdefault(key, folder / name)
            self._known[folder, only_marked] = found
        return self._known[folder, only_marked]
