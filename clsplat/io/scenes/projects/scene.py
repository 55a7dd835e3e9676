"""What the readers of other programs' projects have in common: photos, wherever they were moved,
and the scene that is built of them."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.errors import MOST_CHARACTERS, InputError
from clsplat.georeference import Georeference
from clsplat.io.fields import text
from clsplat.io.georeference import crs as systems
from clsplat.io.georeference.crs import conversion
from clsplat.io.scenes.posed import Cloud, PosedPhoto, posed_scene, read_cloud
from clsplat.io.scenes.sources import IMAGES, PHOTO_SUFFIXES, photo_folder
from clsplat.placement.alignment import Similarity, fitted
from clsplat.scene import Scene

STEP = 10.0  # metres from the middle of the cameras, where the map is compared with the earth


class PhotoFiles:
    """The photos of a project, in its folder `project`.

    They are in `folder`: the one given as --images, else images/ of the project, else the
    project's own.
    """

    def __init__(self, project: Path, images: str = "") -> None:
        folder = photo_folder(project, images)
        self.folder = folder if images or folder.is_dir() else project
        self.project, self._given = project, bool(images)

    def found(self, names: Iterable[object]) -> list[tuple[str, Path]]:
        """Find photos as `find` does; InputError if some are missing."""
        found = [self.find(name) for name in names]
        missing = [source for _, source in found if not os.path.isfile(source)]
        if missing:
            raise InputError(
                f"{str(missing[0])[:MOST_CHARACTERS]}: no such image ({len(missing)} "
                f"of {len(found)} photos of the project are missing); put them "
                "there, or name their folder with --images"
            )
        return found

    def find(self, name: object) -> tuple[str, Path]:
        """Find a photo.

        Parameters
        ----------
        name : as the project has it: a path of this or another machine, a file name, or a label
            without suffix.

        Returns
        -------
        The name of its view, relative to the folder of photos if it is there, and its path, which
        does not exist if no file fits.
        """
        parts = PurePosixPath(text(name, "the name of a photo").replace("\\", "/")).parts
        parts = tuple(part for part in parts if part not in ("/", "//", ".."))
        if not parts:
            raise ValueError(f"{str(name)[:80]!r} is not the name of a photo")
        places = [self.folder.joinpath(*parts[first:]) for first in range(len(parts))]
        found = next(filter(os.path.isfile, places), None) or self._alike(parts)
        if found:
            return found.relative_to(self.folder).as_posix(), found
        outside = self.project / str(name)
        if not self._given and os.path.isfile(outside):  # --images has all photos
            return "/".join(parts), outside
        return parts[-1], self.folder / parts[-1]

    def _alike(self, parts: tuple[str, ...]) -> Path | None:
        """The file of the photo folder whose name and folders agree most with these; InputError if
        two agree equally."""

        def likeness(path: Path) -> int:
            pairs = zip(path.parts[-2::-1], parts[-2::-1])
            equal = [own.casefold() == named.casefold() for own, named in pairs]
            return (equal + [False]).index(False)

        found = sorted(self._files.get(parts[-1].casefold(), []), key=likeness, reverse=True)
        if len(found) > 1 and likeness(found[0]) == likeness(found[1]):
            places = ", ".join(str(path)[:MOST_CHARACTERS] for path in found[:2])
            raise InputError(
                f"{self.folder}: several photos fit {parts[-1][:80]!r}: {places}; "
                "name the folder of the right ones with --images"
            )
        return found[0] if found else None

    @cached_property
    def _files(self) -> dict[str, list[Path]]:
        """The photos below the folder, by file name and by stem, in lower case."""
        files: dict[str, list[Path]] = {}
        for path in sorted(self.folder.rglob("*")):
            if path.suffix.lower() in PHOTO_SUFFIXES:
                for key in {path.name.casefold(), path.stem.casefold()}:
                    files.setdefault(key, []).append(path)
        return files


class OnEarth(NamedTuple):
    """Where a project lies: the similarity to geocentric coordinates, its CRS, which is used if it
    is projected, in metres (else UTM), and the program that found it."""

    to_earth: Similarity
    definition: str
    program: str


def project_scene(
    path: Path,
    files: PhotoFiles,
    photos: Sequence[PosedPhoto],
    points: Cloud | None = None,
    *,
    place: OnEarth | None = None,
    z_is_up: bool = False,
    notes: Sequence[str] = (),
) -> Scene:
    """Build the scene of a project and recentre it; see `posed_scene`.

    Parameters
    ----------
    path : the file that messages name.
    files : where the photos were searched.
    photos, points : in the project's coordinates. Without points: those of points3D.ply in the
        folder, on the map if there is one, else sampled where two cameras see.
    place : on the earth, to which photos and points are moved.
    """
    if not photos:
        raise InputError(f"{path}: no photo of the project has a pose; align the photos first, and export again")
    georeference = None
    if place is not None:
        similarity, georeference = on_map(
            place.to_earth,
            np.array([photo.position for photo in photos]),
            systems.project_crs(place.definition),
            f"{place.program}'s alignment of {len(photos)} photos",
        )
        photos = [
            replace(photo, rotation=photo.rotation @ similarity.rotation.T, position=similarity(photo.position))
            for photo in photos
        ]
        if points is not None:
            points = points._replace(positions=similarity(points.positions))
    if points is None:
        points = read_cloud(files.project, None, np.eye(3, 4))
        if points is not None and georeference is not None:
            points = points._replace(positions=georeference.from_map(points.positions))
    return posed_scene(
        path,
        files.project,
        photos,
        points,
        georeference=georeference,
        z_is_up=z_is_up,
        notes=notes,
        smaller=files.folder if files.folder.name != IMAGES else None,
    )


def topocentric(latitude: float, longitude: float, height: float) -> Similarity:
    """From east, north and up in metres at a place (degrees, metres) to geocentric coordinates."""
    (centre,) = conversion(systems.GEODETIC, systems.GEOCENTRIC)([(longitude, latitude, height)])
    axes = scipy.spatial.transform.Rotation.from_euler("ZX", (90 + longitude, 90 - latitude), degrees=True)
    return Similarity(1.0, axes.as_matrix(), centre)


def on_map(
    to_earth: Similarity, centres: NDArray[np.float64], crs: str, source: str
) -> tuple[Similarity, Georeference]:
    """Find how a reconstruction lies on a map.

    A reconstruction is rigid, a map is not: near one place a map is a similarity of the earth up to
    its curvature, which over a kilometre makes centimetres. So a scene is moved to the map by the
    similarity at the middle of its cameras, and what it misses is stated as the residual.

    Parameters
    ----------
    to_earth : from the reconstruction's coordinates to geocentric ones (WGS 84, metres).
    centres : [V, 3], of the cameras, in the reconstruction's coordinates.
    crs : a projected CRS in metres; "": the UTM zone of the cameras.
    source : of the georeference.

    Returns
    -------
    The similarity to the scene's original coordinates (east, north, up in metres), and their
    georeference; its offset is a place near the cameras, in whole metres. ValueError if the cameras
    are not near the earth's surface, or outside of the map.
    """
    middle = np.median(centres, axis=0)
    geodetic = conversion(systems.GEOCENTRIC, systems.GEODETIC, partial=True)
    (place,) = geodetic(to_earth(middle[None]))
    if not (np.isfinite(place).all() and abs(place[2]) < 1e5):
        raise ValueError("its cameras are not near the earth's surface")
    crs = crs or systems.utm_zone(*place[:2])
    around = middle + STEP / to_earth.scale * np.concatenate([np.eye(3), -np.eye(3)])
    exact = conversion(systems.GEODETIC, crs, partial=True)(geodetic(to_earth(np.concatenate([around, centres]))))
    offset = np.round(exact[:6].mean(axis=0))
    similarity = fitted(around, exact[:6] - offset) if np.isfinite(exact).all() else None
    if similarity is None:
        raise ValueError(f"its cameras are outside of {crs[:80]}")
    if np.linalg.det(exact[:3] - exact[3:6]) < 0:  # as with axes to the south and to the west
        raise ValueError("its coordinates are mirrored")
    missed = similarity(centres) + offset - exact[6:]
    residual = float(np.sqrt((missed**2).sum(axis=1).mean()))
    east, north, height = offset.tolist()
    return similarity, Georeference(crs, (east, north, height), source, residual)
