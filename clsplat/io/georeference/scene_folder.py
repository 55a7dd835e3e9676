"""Georeferences a scene folder with a COLMAP model: writes the same scene in other coordinates."""

import os
import shutil
from collections.abc import Collection
from pathlib import Path

from numpy.typing import ArrayLike

from clsplat.errors import InputError
from clsplat.io.atomic import PARTIAL
from clsplat.io.folders import make_folder
from clsplat.io.georeference.adjustment import check_marks
from clsplat.io.georeference.control_points import read_control_points
from clsplat.io.georeference.crs import scene_crs
from clsplat.io.georeference.files import write_georeference, write_orientation
from clsplat.io.georeference.reconstruction import Placed, place_reconstruction
from clsplat.io.photos.metadata import read_metadata
from clsplat.io.photos.mrk import with_mrk
from clsplat.io.scenes.colmap import read_model, read_reconstruction, write_reconstruction
from clsplat.io.scenes.sources import photo_folder
from clsplat.placement.plausible import NotGeoreferenced

SPARSE = "sparse"


def georeference_scene(
    folder: Path,
    output: Path,
    *,
    photos: Path | None = None,
    crs: str = "",
    gcp: Path | None = None,
    checks: Collection[str] = (),
    up: ArrayLike | None = None,
) -> Placed:
    """Write a scene with metric axes east, north and up; nothing is written if it cannot be
    georeferenced.

    The new folder has its own model; photos and all other folders of the scene are linked, or
    copied where the file system has no links.

    Parameters
    ----------
    folder : of the scene, with a COLMAP model of any camera model.
    output : the new folder, which must not exist.
    photos : folder of photos with GPS, by the names in the model; None: the scene's own.
    crs : the coordinate reference system; "": that of `gcp`, or the UTM zone.
    gcp : a file of ground control points, marked in pixels of the model's photos; None: GPS.
    checks : names of points of `gcp` that take no part, and show the error.
    up : float[3], in the scene; None: by gimbals, or by cameras and points.
    """
    control = read_control_points(gcp, scene_crs(crs) if crs else None, checks)
    model, arrays = read_model(folder)  # pycolmap does not survive every damaged file
    if os.path.lexists(output):
        raise InputError(f"{output}: exists already; choose another --output")
    source = photos or photo_folder(folder)
    names = sorted(set(map(str, arrays["files"])))  # of photos: a wide lens has several views
    check_marks(control.points, names)
    paths = {name: source / name for name in names if (source / name).is_file()}
    metadata = dict(zip(paths, with_mrk((path, read_metadata(path)) for path in paths.values())[0]))
    reconstruction = read_reconstruction(model)
    try:
        placed = place_reconstruction(reconstruction, metadata, control, up=up)
    except NotGeoreferenced as error:
        cure = "" if gcp else "; give photos with GPS (--photos), or ground control points (--gcp)"
        raise InputError(f"{folder}: not georeferenced: {error}{cure}") from None
    partial = output.with_name(output.name + PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)
    # before the new folder is made, which may be in that of the scene
    linked = [
        entry
        for entry in sorted(folder.iterdir())
        if entry.is_dir() and entry.name != SPARSE and not entry.name.startswith(".")
    ]
    make_folder(partial / SPARSE / "0")
    try:
        write_reconstruction(partial / SPARSE / "0", reconstruction)
        for entry in linked:
            _link(entry, partial / entry.name)
        write_georeference(partial, placed.georeference)
        write_orientation(partial, placed.up)
        os.rename(partial, output)
    except OSError as error:
        raise InputError(
            f"{output}: cannot be written ({error.strerror}); check that the disk has "
            "space, and choose another --output"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return placed


def _link(source: Path, link: Path) -> None:
    try:
        link.symlink_to(source.resolve(), target_is_directory=True)
    except OSError:
        shutil.copytree(source, link)
