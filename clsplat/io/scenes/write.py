"""Writes a scene as a folder with a COLMAP model."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.folders import link_file, make_folder
from clsplat.io.georeference.files import write_placement
from clsplat.io.photos.images import encode_image
from clsplat.io.photos.masks import MASKS
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.io.scenes.colmap_files import write_colmap
from clsplat.scene import Scene, View

DEPTH = "depth"  # folder of the depth maps
QUALITY = 96  # of JPEG, of photos that become smaller


def write_scene(folder: Path, scene: Scene, downscale: float = 1.0, linked: bool = True) -> None:
    """Write a scene as a folder that `read_scene` reads, in original coordinates.

    Photos, masks and depth maps stay the files that they are. Photos that are encoded anew have
    neither lens nor levels of their own: those that become smaller, those of a lens, arrays, and
    photos with samples that are stretched (with the levels of the whole scene).

    Parameters
    ----------
    downscale : divides width and height of the photos.
    linked : whether files are links; else they are copied.
    """
    make_folder(folder)
    write_placement(folder, scene)
    views = [replace(view, camera=view.camera.reduced(downscale)) for view in scene.views]
    write_colmap(
        folder / "sparse" / "0",
        [replace(view, camera=view.camera.shifted(-scene.offset)) for view in views],
        scene.points + scene.offset,
        scene.colours,
        scene.observations,
    )
    for view in views:
        kept = downscale == 1 and isinstance(view.source, Path) and not (view.levels or view.lens)
        if not kept:
            _write_encoded(folder, view, "png" if downscale == 1 and not view.lens else "jpg")
        for file, place in _files(folder, view, kept):
            link_file(file, place, "symbolic" if linked else "copy")


def _write_encoded(folder: Path, view: View, suffix: str) -> None:
    """Write the photo of a view as its camera shows it, and the mask of the pixels that count."""
    valid = read_valid(view)
    images = [(folder / "images" / view.name, read_photo(view), suffix)]
    if valid is not None:
        images.append(
            (folder / MASKS / f"{view.name}.png", np.repeat(valid[:, :, None], 3, axis=2) * np.uint8(255), "png")
        )
    for path, pixels, form in images:
        make_folder(path.parent)
        path.write_bytes(encode_image(pixels, form, QUALITY, path))


def _files(folder: Path, view: View, photo: bool = True) -> Iterator[tuple[Path, Path]]:
    """(photo, mask or depth map, its place in a folder), of those that are files; photo and mask
    only if asked for. A map of a lens is of use with its photo only."""
    if photo and isinstance(view.source, Path):
        yield view.source, folder / "images" / view.name
    if photo and isinstance(view.mask, Path):
        yield view.mask, folder / MASKS / f"{view.name}.png"
    if view.depth and (photo or view.lens is None):
        yield view.depth, folder / DEPTH / f"{view.name}{view.depth.suffix}"


def link_again(folder: Path, views: Iterable[View]) -> None:
    """Replace the links of a folder to photos that were moved since."""
    for file, link in (pair for view in views for pair in _files(folder, view)):
        if link.is_symlink() and not link.exists():
            try:
                link.unlink()
            except OSError as error:
                raise InputError(
                    f"{link}: cannot be replaced ({error.strerror}); check that its folder may be written"
                ) from None
            link_file(file, link)
