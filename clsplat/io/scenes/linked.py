"""A part of a scene as a folder of its own, whose photos are links."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.folders import link_file
from clsplat.io.georeference.files import write_placement
from clsplat.io.photos.images import encode_image, read_image
from clsplat.io.photos.mask_files import MASKS
from clsplat.io.scenes.colmap_write import Tracks, write_colmap
from clsplat.io.scenes.packed import write_packed
from clsplat.scene import Scene, View

DEPTH = "depth"  # folder of the depth maps
PACKED = "scene.npz"


def write_linked(folder: Path, scene: Scene) -> None:
    """Write a scene as a folder that `read_scene` reads, in original coordinates.

    Photos, masks and depth maps are links; a packed scene is packed again.
    """
    write_placement(folder, scene)
    if isinstance(scene.views[0].source, bytes):
        write_packed(scene, folder / PACKED)
        return
    points = scene.points + scene.offset
    views = [replace(view, camera=view.camera.shifted(-scene.offset)) for view in scene.views]
    known = (np.zeros((0, 2), int) if scene.observations is None else scene.observations)
    pixels = np.empty((len(known), 2))
    for number, view in enumerate(scene.views):
        rows = np.flatnonzero(known[:, 1] == number)
        pixels[rows] = view.camera.project(scene.points[known[rows, 0]])[0]
    write_colmap(folder / "sparse" / "0", views, points, scene.colours,
                 Tracks(known[:, 0], known[:, 1], pixels))
    for photo, link in _photo_links(folder, views):
        link_file(photo, link)
    for view in views:
        if view.levels:  # those of the whole scene, not those of a part
            link = folder / "images" / view.name
            link.unlink()
            link.write_bytes(encode_image(read_image(view.source, levels=view.levels), "png", 0,
                                          view.name))


def _photo_links(folder: Path, views: Iterable[View]) -> Iterator[tuple[Path, Path]]:
    """(photo, mask or depth map, its link in the folder of a block), if not packed."""
    for view in views:
        if isinstance(view.source, Path):
            yield view.source, folder / "images" / view.name
        if isinstance(view.mask, Path):
            yield view.mask, folder / MASKS / f"{view.name}.png"
        if view.depth:
            yield view.depth, folder / DEPTH / f"{view.name}{view.depth.suffix}"


def link_again(folder: Path, views: Iterable[View]) -> None:
    """Replace the links of a block to photos that were moved since."""
    for photo, link in _photo_links(folder, views):
        if link.is_symlink() and not link.exists():
            try:
                link.unlink()
            except OSError as error:
                raise InputError(f"{link}: cannot be replaced ({error.strerror}); check that its "
                                 "folder may be written") from None
            link_file(photo, link)
