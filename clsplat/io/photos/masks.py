"""Masks of photos: which pixels count in training and in scores.

A mask is an image that is dark where the photo does not count. Nor do transparent pixels of a photo
with alpha, and those that a lens does not show. docs/guide/photos.md has the names of masks.
"""

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.photos.images import image_size, read_alpha
from clsplat.io.photos.photo import Source, opened
from clsplat.io.photos.resample import joined, resample
from clsplat.io.scenes.sources import PHOTO_SUFFIXES
from clsplat.scene import Scene, View

MASKS = "masks"
FOLDERS = (MASKS, "mask", "image_masks", "images_mask", "images_masks", ".mask")
MARKED = re.compile(r"(.+)(?:_mask|\.mask)", re.IGNORECASE)  # a name without its suffix
LEAST_BRIGHT = 128  # of 255, of pixels that count
TOLERANCE = 0.02  # of the ratio of the sides of an image and its photo


def photo_of(name: str) -> str:
    """The name or the stem of the photo of which a name is that of a mask; "" if it is not."""
    path = PurePosixPath(name)
    found = MARKED.fullmatch(path.stem) if path.suffix.lower() in PHOTO_SUFFIXES else None
    return found[1] if found else ""


def mask_folders(folder: Path) -> list[Path]:
    """The folders of masks in a folder."""
    return [folder / name for name in FOLDERS if (folder / name).is_dir()]


class MaskFiles:
    """Finds the masks of photos; `used` has those that were found.

    Parameters
    ----------
    folders : of masks, in which they have the names of photos.
    beside : whether masks are also searched beside each photo, and in folders beside it.
    """

    def __init__(self, folders: Iterable[Path], beside: bool = True) -> None:
        self._folders, self._beside = tuple(folders), beside
        self._known: dict[tuple[Path, bool], dict[str, Path]] = {}
        self.used: set[Path] = set()

    def of(self, name: str, photo: Path | None = None) -> Path | None:
        """The mask of a photo of this name below the folders and this file; None: it has none."""
        relative = Path(name)
        places = [((folder / relative).parent, False) for folder in self._folders]
        if photo is not None and self._beside:
            places.append((photo.parent, True))
            places += [
                ((above / folder / photo.relative_to(above)).parent, False)
                for above in photo.parents[: len(relative.parts)]
                for folder in FOLDERS
            ]
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


def with_masks(scene: Scene, folder: Path) -> Scene:
    """The scene with the masks that its folder has for its photos, and a note."""
    folders = mask_folders(folder)
    files = MaskFiles(folders)
    views = tuple(
        view
        if view.mask is not None
        else replace(view, mask=files.of(view.name, view.source if isinstance(view.source, Path) else None))
        for view in scene.views
    )
    count = sum(view.mask is not None for view in views)
    if folders and not count:
        raise InputError(
            f"{folders[0]}: has no mask for any photo; name them after the photos,"
            f" such as {scene.views[0].name}.png, or rename the folder"
        )
    if not files.used:
        return replace(scene, views=views)
    places = ", ".join(sorted({f"{mask.parent.name}/" for mask in files.used}))
    note = f"{count} of {len(views)} photos have a mask in {places}: dark pixels are left out of training and scores"
    return replace(scene, views=views, notes=(*scene.notes, note))


def stored_masks(view: View) -> Iterator[NDArray[np.bool_]]:
    """Yield the masks of a view's photo as it is stored, bool[h, w] of any size each."""
    if view.mask is not None:
        name = view.mask if isinstance(view.mask, Path) else f"the mask of {view.name}"
        yield read_mask(view.mask, name, photo_size(view))
    if view.transparent:
        yield read_alpha(view.source) >= LEAST_BRIGHT


def photo_size(view: View) -> tuple[int, int]:
    """(width, height) of the photo of a view as it is stored, pixels."""
    return view.lens.size if view.lens else image_size(view.source)


def check_shape(name: str | Path, kind: str, size: tuple[int, int], photo: tuple[int, int]) -> None:
    """Check that a mask or a depth map has the shape of its photo; sizes are (width, height)."""
    if abs(size[0] * photo[1] / (size[1] * photo[0]) - 1) > TOLERANCE:
        raise InputError(
            f"{name}: the {kind} has {size[0]}x{size[1]} pixels and its photo "
            f"{photo[0]}x{photo[1]}; make it for this photo"
        )


def read_mask(source: Source, name: str | Path, photo: tuple[int, int]) -> NDArray[np.bool_]:
    """Read which pixels of a stored photo of this size (width, height) count, by its mask: bool[h,
    w] of any size. The name is for messages."""
    with opened(source) as mask:
        size = mask.width, mask.height
        grey = joined((band.max(axis=2, keepdims=True) for band in mask.bands(0, mask.height)), size, 1)[:, :, 0]
    check_shape(name, "mask", size, photo)
    if grey.max() == 1:
        raise InputError(
            f"{name}: its pixels are 0 and 1 of 255, which are both dark; write 255 where the photo counts"
        )
    bright: NDArray[np.bool_] = np.greater_equal(grey, LEAST_BRIGHT, out=grey.view(bool))
    return bright


def unmasked(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Bring a mask bool[h, w] to a size (width, height); a pixel counts if all that it covers
    do."""
    if mask.all():
        return np.ones(size[::-1], bool)
    share = resample(mask[:, :, None] * np.uint8(255), size)[:, :, 0]
    valid: NDArray[np.bool_] = share == 255
    return valid
