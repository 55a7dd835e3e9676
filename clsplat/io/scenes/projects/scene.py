"""A project of another photogrammetry program as a scene: what its readers have in common.

A reader translates cameras to COLMAP's models and axes, exactly or not at all; the scene then is
built as that of a COLMAP model is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.io.georeference.crs import has_pyproj, project_crs
from clsplat.io.georeference.earth import on_map
from clsplat.io.photos.lenses import Model, brown_model, undistorted_model
from clsplat.io.reason import reason
from clsplat.io.scenes.checks import LARGEST_COORDINATE, checked_scene
from clsplat.io.scenes.cloud import read_cloud
from clsplat.io.scenes.posed import PLACEHOLDER_POINTS, exact_poses, with_points
from clsplat.io.scenes.projects.photo_files import PhotoFiles, check_present
from clsplat.io.scenes.sources import IMAGES, checked_photos
from clsplat.placement.similarity import Similarity
from clsplat.scene import Scene

LONGEST_SIDE = 1 << 20  # pixels
NO_PYPROJ = ("its coordinates are kept as they are, without a map's: that needs pyproj; "
             "`pip install pyproj`, then read it again")
FLIPPED = np.array([1.0, -1.0, -1.0])  # camera axes right, up, back to right, down, forward


@dataclass(frozen=True)
class Optics:
    """The camera model of a photo, with pixels as in COLMAP: (0, 0) is the outer corner of the
    first.

    Attributes
    ----------
    size : (width, height), pixels.
    focal, centre : (x, y), pixels.
    model : COLMAP's name and parameters; None: a pinhole camera.
    """

    size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    model: Model | None = None


@dataclass(frozen=True, eq=False)
class ProjectPhoto:
    """A photo of a project.

    Attributes
    ----------
    name, source : of the view, and its file.
    optics : its camera model.
    rotation : float64[3, 3], world to camera; nearly a rotation, as far as files are rounded.
    position : float64[3], the optical centre, world.
    """

    name: str
    source: Path
    optics: Optics
    rotation: NDArray[np.float64]
    position: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ProjectPoints:
    """The sparse points of a project.

    Attributes
    ----------
    positions : float64[N, 3], world.
    colours : uint8[N, 3]; None: unknown.
    observations : int[M, 2], rows (point, photo); None: unknown.
    """

    positions: NDArray[np.float64]
    colours: NDArray[np.uint8] | None = None
    observations: NDArray[np.int64] | None = None


def brown(size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float],
          radial: Sequence[float] = (), tangential: Sequence[float] = (0.0, 0.0)) -> Optics:
    """A camera with Brown's model; see `lenses.brown_model`."""
    return Optics(size, focal, centre, brown_model((*focal, *centre), radial, tangential))


def only(paths: Iterable[Path], kind: str) -> Path | None:
    """The single one of some files, None if there is none; InputError if there are several."""
    found = sorted(paths)
    if len(found) > 1:
        raise InputError(f"{found[0].parent}: holds several {kind}: {found[0].name}, "
                         f"{found[1].name}; give the file itself instead of its folder")
    return found[0] if found else None


def project_scene(path: Path, folder: Path, files: PhotoFiles, photos: Sequence[ProjectPhoto],
                  points: ProjectPoints | None = None, *, georeference: Georeference | None = None,
                  z_is_up: bool = False, notes: Sequence[str] = ()) -> Scene:
    """Build the scene of a project and recentre it; photos are checked as by `read_colmap`.

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
        cloud = read_cloud(folder, None, np.eye(3, 4))
        if cloud is not None:
            positions, colours = cloud
            points = ProjectPoints(positions if georeference is None else
                                   _near(path, photos, positions, georeference), colours)
    arrays = _arrays(photos)
    positions = PLACEHOLDER_POINTS if points is None else points.positions
    colours = None if points is None else points.colours
    arrays |= {"points": positions, "colours":
               np.zeros((len(positions), 3), np.uint8) if colours is None else colours}
    if points is not None and points.observations is not None:
        arrays["observations"] = points.observations
    models = [photo.optics.model for photo in photos]
    arrays = undistorted_model(path, arrays, models)
    sources = {photo.name: photo.source for photo in photos}
    scene = checked_scene(path, folder.resolve().name, arrays,
                          [sources[name] for name in arrays["files"]])
    scene = replace(scene, path=folder, notes=tuple(notes), georeference=georeference,
                    given_up=np.array([0.0, 0.0, 1.0]) if z_is_up else None)
    smaller = files.folder if files.folder.name != IMAGES else None
    scene = with_points(path, checked_photos(scene, smaller), points is None, colours is None)
    return scene.recentred()


def _arrays(photos: Sequence[ProjectPhoto]) -> dict[str, NDArray[Any]]:
    """The arrays of the photos for `checks.checked_scene`."""
    rotations, translations = exact_poses(np.array([photo.rotation for photo in photos]),
                                          np.array([photo.position for photo in photos]))
    optics = [photo.optics for photo in photos]
    return {"names": np.array([photo.name for photo in photos], object), "rotations": rotations,
            "translations": translations, "focals": np.array([each.focal for each in optics]),
            "centres": np.array([each.centre for each in optics]),
            "sizes": np.array([each.size for each in optics])}


def _near(path: Path, photos: Sequence[ProjectPhoto], positions: NDArray[np.float64],
          georeference: Georeference) -> NDArray[np.float64]:
    """Points of a map in the scene's original coordinates; they may be in these already."""
    centre = np.median([photo.position for photo in photos], axis=0)
    shifted = georeference.from_map(positions)
    with np.errstate(all="ignore"):
        away = [np.median(np.linalg.norm(places - centre, axis=1))
                for places in (positions, shifted)]
    return shifted if away[1] < away[0] else positions


def georeferenced(path: Path, photos: Sequence[ProjectPhoto], points: ProjectPoints | None,
                  to_earth: Callable[[], Similarity], definition: str, source: str
                  ) -> tuple[Sequence[ProjectPhoto], ProjectPoints | None, Georeference | None,
                             tuple[str, ...]]:
    """Move photos and points onto a map.

    Parameters
    ----------
    to_earth : called if pyproj is installed; the similarity to geocentric coordinates.
    definition : of the project's CRS, which is used if it is projected, in metres; else UTM.

    Returns
    -------
    Photos and points in metres, east, north and up; the georeference, None without pyproj, in which
    case nothing is moved; notes for the user.
    """
    if not photos or not has_pyproj():
        return photos, points, None, (NO_PYPROJ,)
    centres = np.array([photo.position for photo in photos])
    try:
        similarity, georeference = on_map(
            to_earth(), centres, project_crs(definition, north_first=True), source)
    except ValueError as error:
        raise InputError(f"{path}: cannot be placed on the earth ({reason(error)}); export it "
                         "again, or without a coordinate system") from None
    rotation = similarity.rotation
    placed = [replace(photo, rotation=photo.rotation @ rotation.T, position=centre)
              for photo, centre in zip(photos, similarity(centres))]
    if points is not None:
        points = replace(points, positions=similarity(points.positions))
    return placed, points, georeference, ()


def finite(value: object, what: str) -> float:
    """A number of JSON or of text; ValueError unless it is finite and of usable size."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{what} is not a number")
    try:
        number = float(value)
    except (ValueError, OverflowError):
        raise ValueError(f"{what} is not a number") from None
    if not abs(number) <= LARGEST_COORDINATE:
        raise ValueError(f"{what} is not a usable number")
    return number


def numbers(values: object, count: int, what: str) -> NDArray[np.float64]:
    """float64[count] of a list of JSON or of words of text; ValueError if it is something else."""
    if isinstance(values, str):
        values = values.split()
    if not isinstance(values, (list, tuple)) or len(values) != count:
        raise ValueError(f"{what} is not {count} numbers")
    return np.array([finite(value, what) for value in values])


def pixels(value: object, what: str) -> int:
    """A side of a photo, pixels; ValueError if it is none."""
    number = finite(value, what)
    if number != int(number) or not 0 < number < LONGEST_SIDE:
        raise ValueError(f"{what} is not a number of pixels")
    return int(number)
