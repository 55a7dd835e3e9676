"""The models that are edited: runs or files, with what is known of their place and their views, and
the boxes and polygons that the user gives in their coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.edit.select import in_polygons, merged, selected
from clsplat.edit.transform import transformed
from clsplat.errors import InputError
from clsplat.evaluation.run import Run, shown
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.georeference import Georeference
from clsplat.io.georeference.crs import conversion
from clsplat.io.georeference.geojson import DEGREES, read_polygons
from clsplat.io.models.formats import read_with_notes
from clsplat.io.models.values import MIP
from clsplat.io.scenes.read import read_scene
from clsplat.partition.region import map_axes
from clsplat.rendering.contribution import contribution
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.slabs import gaussian_limit
from clsplat.scene import View

GEOJSON = (".geojson", ".json")
SEEN = 0.1  # opaque pixels that a gaussian must contribute to a view that sees it


@dataclass(frozen=True, eq=False)
class Source:
    """A model with what its run or file says about it.

    Attributes
    ----------
    path : of the run or the file.
    gaussians : the model.
    georeference : of its original coordinates; None: unknown.
    up : float64[3], the unit vector that points up; None: unknown.
    antialiased : whether it was trained with --antialiased.
    run : the run; None for a file.
    support : int[N], how many training views see each gaussian; None: not measured.
    """

    path: Path
    gaussians: Gaussians
    georeference: Georeference | None = None
    up: NDArray[np.float64] | None = None
    antialiased: bool = False
    run: Run | None = None
    support: NDArray[np.intp] | None = None

    @classmethod
    def open(cls, path: Path) -> Source:
        """Read the model of a run's folder or of a file; InputError if it cannot be read."""
        if path.is_dir():
            run = Run.open(path)
            model = shown(run.finished_model, path).without_spheres()
            return cls(path, model, run.georeference, run.known_up, run.options.antialiased, run)
        model, notes = read_with_notes(path)
        return cls(path, shown(model, path).without_spheres(), notes.georeference, notes.up,
                   notes.antialiased)

    def measured(self, device: Device, scene_path: Path | None,
                 progress: Callable[[int, int], object] | None = None) -> Source:
        """The source with what the training views of a scene see, or of the run's own scene; see
        `seen_by`."""
        if self.run is not None:
            scene, options = self.run.scene(scene_path), self.run.options
            views, _ = scene.split(options.test_every, options.test_offset)
            near = scene.near(options.near)
        else:
            if scene_path is None:
                raise ValueError("a file has no views of its own")
            scene = read_scene(scene_path)
            views, near = scene.views, scene.near(0.0)
        return replace(self, support=seen_by(device, self.gaussians.moved(scene.offset), views,
                                             near, self.antialiased, progress))

    def kept(self, keep: NDArray[np.bool_]) -> Source:
        """The source with some of its gaussians, bool[N]; InputError if none is left."""
        if not keep.any():
            raise InputError(f"{self.path}: none of its {len(keep):,} gaussians would be left; "
                             "check the units and the coordinates of what you gave")
        return replace(self, gaussians=selected(self.gaussians, keep),
                       support=None if self.support is None else self.support[keep])

    def transformed(self, scale: float, rotation: NDArray[np.float64] | None,
                    translation: Sequence[float]) -> Source:
        """The source after a `transform.transformed`; only a translation keeps the georeference."""
        turned = scale != 1 or rotation is not None
        return replace(
            self, gaussians=transformed(self.gaussians, scale, rotation, translation),
            georeference=None if turned else self.georeference,
            up=self.up if self.up is None or rotation is None else rotation @ self.up)

    @property
    def comments(self) -> tuple[str, ...]:
        """How it was trained, for the header of a file."""
        return (MIP,) if self.antialiased else ()

    def in_box(self, box: Sequence[float], coordinates: str) -> NDArray[np.bool_]:
        """bool[N]: whether the gaussians lie in a box: the lowest x, y, z, then the highest, in
        original coordinates (auto, scene) or those of the CRS (map); InputError for others."""
        low, high = np.array(box, np.float64).reshape(2, 3)
        if not (low < high).all():
            raise InputError("--box: is empty; give the lowest x, y and z, then the highest (inf "
                             "and -inf leave a side open)")
        if coordinates == "lonlat":
            raise InputError("--box: cannot be in degrees; use --polygon, or --coordinates map")
        points = self._points()
        if coordinates == "map":
            points = points + self._place("--box").offset
        return np.asarray(((points >= low) & (points <= high)).all(axis=1))

    def in_polygons(self, text: str, coordinates: str) -> NDArray[np.bool_]:
        """bool[N]: whether the gaussians stand above or below polygons on the ground: their
        original x and y if z is up.

        Parameters
        ----------
        text : the path of a GeoJSON file, or corners such as "0,0 10,0 10,10".
        coordinates : scene (original ones of the model), map (of its CRS), lonlat (degrees), or
            auto: the CRS that a GeoJSON file names; otherwise lonlat for a GeoJSON file if the
            model is georeferenced, and scene for all else.
        """
        is_file = text.lower().endswith(GEOJSON)
        polygons, crs = read_polygons(Path(text)) if is_file else ([[_corners(text)]], "")
        if coordinates == "auto" and (not is_file or self.georeference is None and not crs):
            coordinates = "scene"
        if coordinates != "scene":
            place = self._place(f"--polygon {text[:60]}")
            given = {"map": place.crs, "lonlat": DEGREES, "auto": crs or DEGREES}[coordinates]
            if given != place.crs:
                convert = conversion(given, place.crs, "--polygon")
                polygons = [[convert(ring) for ring in rings] for rings in polygons]
            polygons = [[ring - place.offset[:2] for ring in rings] for rings in polygons]
        up = np.array([0.0, 0.0, 1.0]) if self.up is None else self.up
        return in_polygons(self._points() @ map_axes(up).T, polygons)

    def _points(self) -> NDArray[np.float64]:
        return self.gaussians.positions.astype(np.float64) + self.gaussians.offset

    def _place(self, what: str) -> Georeference:
        if self.georeference is None:
            raise InputError(f"{what}: {self.path} has no georeference, so its place on a map is "
                             "unknown; give --coordinates scene")
        return self.georeference


def joined(sources: Sequence[Source]) -> Source:
    """One source of several, in the original coordinates of the first.

    If both are georeferenced, the others are moved by the difference of their map offsets.

    Raises
    ------
    InputError : their CRS differ, or some are for antialiased renderers and others are not.
    """
    first = sources[0]
    models = []
    for source in sources:
        gaussians = source.gaussians
        if source.antialiased != first.antialiased:
            how = "with" if source.antialiased else "without"
            raise InputError(f"{source.path}: was trained {how} --antialiased, unlike "
                             f"{first.path}, so no renderer draws both rightly; train one of them "
                             "again")
        if first.georeference is not None and source.georeference is not None:
            if source.georeference.crs != first.georeference.crs:
                raise InputError(f"{source.path}: has the CRS {source.georeference.crs[:60]}, "
                                 f"{first.path} has {first.georeference.crs[:60]}; georeference "
                                 "both scenes with the same --crs")
            gaussians = gaussians.located(gaussians.offset + np.subtract(
                source.georeference.offset, first.georeference.offset))
        models.append(gaussians)
    return replace(first, gaussians=merged(models), run=None, support=None)


def _corners(text: str) -> NDArray[np.float64]:
    try:
        corners = np.array([[float(value) for value in corner.split(",")]
                            for corner in text.split()])
    except ValueError:
        corners = np.empty(0)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(
            corners).all():
        raise InputError(f"--polygon {text[:60]}: expects at least three corners such as "
                         "\"0,0 10,0 10,10\", or a GeoJSON file")
    return corners


def seen_by(device: Device, gaussians: Gaussians, views: Sequence[View], near: float,
            antialiased: bool = False, progress: Callable[[int, int], object] | None = None
            ) -> NDArray[np.intp]:
    """How many views see each gaussian, int[N].

    What counts is its weight in the blended image, so gaussians behind others are not seen.
    The cameras of the views and the gaussians share a frame; `progress` is called with the number
    of views that are done, and of all.

    Raises
    ------
    InputError : the model is larger than the device.
    """
    if gaussians.count > gaussian_limit(device, gaussians.sh_degree):
        raise InputError(f"{gaussians.count:,} gaussians are more than {device.name} can render at "
                         "a time to see which views support them; crop the model first, or use "
                         "another --device")
    renderer = Renderer(device, gaussians.sh_degree, near, antialiased)
    rows = {field.name: device.upload(gaussians.rows[field.name]) for field in LEARNED}
    count = np.zeros(gaussians.count, np.intp)
    for number, view in enumerate(views, 1):
        width, height = view.camera.width, view.camera.height
        frame = renderer.render(rows, renderer.pack(view.camera), width, height,
                                gaussians.sh_degree)
        ones = device.upload(np.ones((height, width), device.real))
        visible = frame.visible.download()
        weight = contribution(device, frame, ones).download()[:len(visible), 1]
        count[visible] += weight >= SEEN
        if progress:
            progress(number, len(views))
    return count
