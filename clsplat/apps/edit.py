"""The models that are edited: runs or files, with what is known of their place and their photos,
and the boxes and polygons that the user gives in their coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import skimage
from numpy.typing import NDArray

from clsplat.apps.models import in_original, support
from clsplat.edit.select import merged, selected
from clsplat.edit.transform import transformed
from clsplat.errors import InputError
from clsplat.evaluation.run import Run, shown
from clsplat.gaussians import Gaussians
from clsplat.io.fields import LARGEST_COORDINATE, reading
from clsplat.io.georeference.crs import conversion
from clsplat.io.models.formats import read_with_notes
from clsplat.io.models.values import Notes, mode_comment
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular
from clsplat.io.scenes.read import read_scene
from clsplat.partition.region import map_axes

GEOJSON = (".geojson", ".json")
DEGREES = "OGC:CRS84"  # longitude and latitude, which RFC 7946 prescribes
Polygon = list[NDArray[np.float64]]  # the outline and the holes, [K, 2]


@dataclass(frozen=True, eq=False)
class Source:
    """A model, and what its file records beside it; `run` : None for a file."""

    path: Path
    gaussians: Gaussians
    notes: Notes
    run: Run | None = None

    @classmethod
    def open(cls, path: Path) -> Source:
        """Read the model of a run's folder or of a file; InputError if it cannot be read."""
        if path.is_dir():
            run = Run.open(path)
            model, notes = run.finished_model, Notes((mode_comment(run.options.antialiased),), run.up, run.georeference)
        else:
            run, (model, notes) = None, read_with_notes(path)
        return cls(path, shown(model, path).without_spheres(), notes, run)

    def kept(self, keep: NDArray[np.bool_]) -> Source:
        """The source with some of its gaussians, bool[N]; InputError if none is left."""
        if not keep.any():
            raise InputError(
                f"{self.path}: none of its {len(keep):,} gaussians would be left; "
                "check the units and the coordinates of what you gave"
            )
        return replace(self, gaussians=selected(self.gaussians, keep))

    def transformed(self, scale: float, rotation: NDArray[np.float64] | None, translation: Sequence[float]) -> Source:
        """The source after a `transform.transformed`; only a translation keeps the georeference."""
        notes = self.notes
        if rotation is not None and notes.up is not None:
            notes = replace(notes, up=rotation @ notes.up)
        if scale != 1 or rotation is not None:
            notes = replace(notes, georeference=None)
        return replace(self, notes=notes, gaussians=transformed(self.gaussians, scale, rotation, translation))

    def support(self, scene_path: Path | None) -> NDArray[np.int64]:
        """int64[N]: how many photos show the place of each gaussian, hidden there or not.

        Parameters
        ----------
        scene_path : the scene with these photos; None: that of the run.
        """
        if self.run is not None:
            scene = self.run.scene(scene_path)
        elif scene_path is not None:
            scene = read_scene(scene_path)
        else:
            raise InputError(f"--min-support: {self.path} is a file, whose photos are unknown; name them with --scene")
        return support(self.gaussians, in_original(scene))

    def in_box(self, box: Sequence[float]) -> NDArray[np.bool_]:
        """bool[N]: whether the gaussians lie in a box: the lowest x, y, z, then the highest, in
        original coordinates."""
        low, high = np.array(box, np.float64).reshape(2, 3)
        if not (low < high).all():
            raise InputError(
                "--box: is empty; give the lowest x, y and z, then the highest (inf and -inf leave a side open)"
            )
        points = self._points()
        return np.asarray(((points >= low) & (points <= high)).all(axis=1))

    def in_polygons(self, text: str) -> NDArray[np.bool_]:
        """bool[N]: whether the gaussians stand above or below polygons on the ground, but not in
        holes of these: their original x and y if z is up.

        Parameters
        ----------
        text : corners such as "0,0 10,0 10,10" in original coordinates, or the path of a GeoJSON
            file: in the CRS that it names; otherwise in longitude and latitude if the model is
            georeferenced, and in original coordinates if not.
        """
        place, crs = self.notes.georeference, ""
        if text.lower().endswith(GEOJSON):
            polygons, crs = read_polygons(Path(text))
            if crs and place is None:
                raise InputError(
                    f"--polygon {text[:60]}: {self.path} has no georeference, so its "
                    "place on a map is unknown; give corners in its own coordinates"
                )
            crs = crs or DEGREES
        else:
            try:
                polygons = [[_ring([corner.split(",") for corner in text.split()])]]
            except ValueError:
                raise InputError(
                    f'--polygon {text[:60]}: expects at least three corners such as "0,0 10,0 10,10", or a GeoJSON file'
                ) from None
        if crs and place is not None:
            convert = conversion(crs, place.crs, "--polygon")
            polygons = [[convert(ring) - place.offset[:2] for ring in rings] for rings in polygons]
        up = np.array([0.0, 0.0, 1.0]) if self.notes.up is None else self.notes.up
        points = self._points() @ map_axes(up).T
        inside = np.zeros(len(points), bool)
        for rings in polygons:
            inside |= np.logical_xor.reduce([skimage.measure.points_in_poly(points, ring) for ring in rings])
        return inside

    def _points(self) -> NDArray[np.float64]:
        return self.gaussians.positions.astype(np.float64) + self.gaussians.offset


def joined(sources: Sequence[Source]) -> Source:
    """One source of several, in the original coordinates of the first.

    If both are georeferenced, the others are moved by the difference of their map offsets.

    Raises
    ------
    InputError : their CRS differ, or some are for antialiased renderers and others are not.
    """
    first = sources[0]
    place, models = first.notes.georeference, []
    for source in sources:
        gaussians, other = source.gaussians, source.notes.georeference
        if source.notes.antialiased != first.notes.antialiased:
            how = "with" if source.notes.antialiased else "without"
            raise InputError(
                f"{source.path}: was trained {how} --antialiased, unlike "
                f"{first.path}, so no renderer draws both rightly; train one of them "
                "again"
            )
        if place is not None and other is not None:
            if other.crs != place.crs:
                raise InputError(
                    f"{source.path}: has the CRS {other.crs[:60]}, {first.path} has "
                    f"{place.crs[:60]}; georeference both scenes with the same --crs"
                )
            gaussians = gaussians.located(gaussians.offset + np.subtract(other.offset, place.offset))
        models.append(gaussians)
    return replace(first, gaussians=merged(models), run=None)


def read_polygons(path: str | Path) -> tuple[list[Polygon], str]:
    """Read the polygons of a GeoJSON file (RFC 7946, and older ones that name their CRS), and that
    CRS, "" without one; geometries of other kinds are left out."""
    with reading(path, "GeoJSON", "export the polygons again"):
        record = object_of(read_regular(path))
        polygons = list(_polygons(record))
    if not polygons:
        raise InputError(f"{path}: has no polygon; draw one, or give another file")
    match record:
        case {"crs": {"properties": {"name": str(crs)}}}:  # of older files, as pyproj accepts it
            return polygons, crs
    return polygons, ""


def _polygons(item: Any) -> Iterator[Polygon]:
    """The polygons of a geometry, a feature or a collection."""
    match item:
        case {"type": "FeatureCollection", "features": [*members]} | {
            "type": "GeometryCollection",
            "geometries": [*members],
        }:
            for member in members:
                yield from _polygons(member)
        case {"type": "Feature", "geometry": geometry}:
            if geometry is not None:  # it may have no place
                yield from _polygons(geometry)
        case {"type": "Polygon", "coordinates": [_, *_] as rings}:
            yield [_ring(ring) for ring in rings]
        case {"type": "MultiPolygon", "coordinates": [*polygons]}:
            for rings in polygons:
                yield from _polygons({"type": "Polygon", "coordinates": rings})
        case {"type": "Point" | "MultiPoint" | "LineString" | "MultiLineString"}:
            pass
        case _:
            raise ValueError("a part of it is no feature or geometry")


def _ring(corners: Sequence[Sequence[Any]]) -> NDArray[np.float64]:
    """The corners [K, 2] of a polygon, without their heights."""
    ring = np.array([corner[:2] for corner in corners], np.float64)
    if ring.shape[1:] != (2,) or len(ring) < 3 or not (abs(ring) <= LARGEST_COORDINATE).all():
        raise ValueError("a polygon needs at least three corners of usable numbers")
    return ring
