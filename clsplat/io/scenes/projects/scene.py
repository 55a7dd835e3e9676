"""A project of another photogrammetry program as a scene: what its readers have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.io.georeference.crs import project_crs
from clsplat.io.georeference.earth import on_map
from clsplat.io.reason import reason
from clsplat.io.scenes.posed import Cloud, PosedPhoto, posed_scene, read_cloud
from clsplat.io.scenes.projects.photo_files import PhotoFiles, check_present
from clsplat.io.scenes.sources import IMAGES
from clsplat.placement.similarity import Similarity
from clsplat.scene import Scene


def project_scene(path: Path, folder: Path, files: PhotoFiles, photos: Sequence[PosedPhoto],
                  points: Cloud | None = None, *, georeference: Georeference | None = None,
                  z_is_up: bool = False, notes: Sequence[str] = ()) -> Scene:
    """Build the scene of a project and recentre it; see `posed_scene`.

    Parameters
    ----------
    path : the file that messages name.
    folder : of the project.
    files : where the photos were searched.
    points : None: those of points3D.ply in the folder, else sampled where two cameras see.
    """
    if not photos:
        raise InputError(f"{path}: no photo of the project has a pose; align the photos first, "
                         "and export again")
    check_present([photo.source for photo in photos])
    if points is None:
        points = read_cloud(folder, None, np.eye(3, 4))
        if points is not None and georeference is not None:
            points = replace(points, positions=_near(photos, points.positions, georeference))
    return posed_scene(path, folder, photos, points, georeference=georeference, z_is_up=z_is_up,
                       smaller=files.folder if files.folder.name != IMAGES else None, notes=notes)


def _near(photos: Sequence[PosedPhoto], positions: NDArray[np.float64],
          georeference: Georeference) -> NDArray[np.float64]:
    """Points of a map in the scene's original coordinates; they may be in these already."""
    centre = np.median([photo.position for photo in photos], axis=0)
    shifted = georeference.from_map(positions)
    with np.errstate(all="ignore"):
        away = [np.median(np.linalg.norm(places - centre, axis=1))
                for places in (positions, shifted)]
    return shifted if away[1] < away[0] else positions


def georeferenced(path: Path, photos: Sequence[PosedPhoto], points: Cloud | None,
                  to_earth: Similarity, definition: str, source: str
                  ) -> tuple[Sequence[PosedPhoto], Cloud | None, Georeference | None]:
    """Move photos and points onto a map.

    Parameters
    ----------
    to_earth : to geocentric coordinates.
    definition : of the project's CRS, which is used if it is projected, in metres; else UTM.

    Returns
    -------
    Photos and points in metres, east, north and up; the georeference, None without photos.
    """
    if not photos:
        return photos, points, None
    centres = np.array([photo.position for photo in photos])
    try:
        similarity, georeference = on_map(
            to_earth, centres, project_crs(definition, north_first=True), source)
    except ValueError as error:
        raise InputError(f"{path}: cannot be placed on the earth ({reason(error)}); export it "
                         "again, or without a coordinate system") from None
    placed = [replace(photo, rotation=photo.rotation @ similarity.rotation.T, position=centre)
              for photo, centre in zip(photos, similarity(centres))]
    if points is not None:
        points = replace(points, positions=similarity(points.positions))
    return placed, points, georeference


def root_of(data: bytes) -> ElementTree.Element:
    """The root of an XML file; ValueError if it is damaged, or defines entities, which no program
    writes and a few of which may expand to more than the memory holds."""
    if b"<!ENTITY" in data.replace(b"\0", b""):  # in UTF-16, too
        raise ValueError("it defines entities")
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError) as error:  # the last: an unknown encoding
        raise ValueError(str(error)) from None
