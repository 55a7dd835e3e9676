"""A scene: posed photos and a sparse point cloud, in a frame near the origin."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from clsplat.camera import Camera, scene_extent

NEAR_SHARE = 1 / 500  # of the extent: holds for scenes in any unit
# cameras this much closer together than the points are away (or agreeing but for rounding) say
# nothing about the scene's size: half a pixel then is half the depth at a focal length of 1000
LEAST_PARALLAX = 1e-3


@dataclass(frozen=True, eq=False)
class View:
    """One photo: its name within the scene, its camera, and where its pixels come from.

    source: a file path, or the encoded bytes of the image (packed scenes).
    """

    name: str
    camera: Camera
    source: Path | bytes

    def sees(self, points):
        """bool[N]: which points float64[N, 3] lie in front and within the image, hidden or not."""
        pixels, depths = self.camera.project(points)
        size = self.camera.width, self.camera.height
        return (depths > 0) & (pixels > 0).all(axis=1) & (pixels < size).all(axis=1)


@dataclass(frozen=True, eq=False)
class Scene:
    """Views sorted by name, and sparse points.

    points: float64[N, 3]; colours: uint8[N, 3]; offset: float64[3], and unit, say where the
    original world coordinates are (`original = offset + unit * local`), so that exports restore
    them; path: where it was read from; observations: int32[M, 2], rows (point, view) that say which
    view the sparse model saw a point in, each once, sorted; None where the file does not tell.
    held_out: names of the views that are for testing where the data set says so itself, or None.
    notes: lines that a user should see: what of the files is not used, or is read in another way.
    Of a block of a larger scene: region, the region.Region it owns, and exposures, name ->
    float64[3, 4], the colour transforms its views start from; else None.
    """

    name: str
    views: tuple[View, ...]
    points: np.ndarray
    colours: np.ndarray
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    path: Path = Path()
    observations: np.ndarray | None = None
    unit: float = 1.0
    held_out: frozenset | None = None
    region: object = None
    exposures: dict | None = None
    notes: tuple[str, ...] = ()

    @property
    def extent(self):
        """World units; see `camera.scene_extent`. The distance of the points where cameras agree.
        """
        extent = scene_extent([view.camera for view in self.views])
        return extent if self.parallax >= LEAST_PARALLAX else self._distance

    @property
    def parallax(self):
        """How far apart the cameras are for the distance of the points."""
        return scene_extent([view.camera for view in self.views]) / max(
            self._distance, np.finfo(float).tiny)

    @property
    def _distance(self):
        """Median distance of a point from the middle of the cameras, world units."""
        middle = np.mean([view.camera.position for view in self.views], axis=0)
        return float(np.median(np.linalg.norm(self.points - middle, axis=1)))

    @property
    def near_plane(self):
        """World units: what is closer to a camera is not drawn."""
        return self.extent * NEAR_SHARE

    def split(self, test_every):
        """(train, test) tuples of views: those of `held_out`, or else every `test_every`-th view by
        name, from the first, is held out; 0 holds out none."""
        if test_every <= 0:
            return self.views, ()
        held_out = self.held_out
        if held_out is None:
            held_out = {view.name for view in self.views[::test_every]}
        return (tuple(v for v in self.views if v.name not in held_out),
                tuple(v for v in self.views if v.name in held_out))

    def reached(self, positions, spread=0.0):
        """bool[N]: which local positions [N, 3] a block's region reaches, its margin included, with
        all that lies `spread` float[N] local units to the sides of them."""
        return self.region.reaches(self.offset + self.unit * np.asarray(positions, np.float64),
                                   self.unit * spread)

    def part(self, indices):
        """The scene of the views int[V] alone, with the points that they see."""
        views = tuple(self.views[i] for i in sorted(indices))
        if self.observations is None:
            seen, known = np.zeros(len(self.points), bool), None
            for view in views:
                seen |= view.sees(self.points)
        else:
            place = np.full(len(self.views), -1)
            place[np.sort(indices)] = np.arange(len(views))
            point, view = self.observations.T
            point, view = point[place[view] >= 0], place[view[place[view] >= 0]]
            seen = np.bincount(point, minlength=len(self.points)) > 0
            known = np.stack([np.cumsum(seen)[point] - 1, view], axis=1).astype(np.int32)
        return replace(self, views=views, points=self.points[seen], colours=self.colours[seen],
                       observations=known)

    def cropped(self, windows):
        """The scene with views that show a part of their photos only, and with the observations in
        it. windows: {name of a view: (left, top, right, bottom), pixels}; others stay whole."""
        views = tuple(replace(v, camera=v.camera.cropped(*windows[v.name]))
                      if v.name in windows else v for v in self.views)
        known = self.observations
        if known is not None:
            inside = np.ones(len(known), bool)
            order = np.argsort(known[:, 1], kind="stable")
            ends = np.searchsorted(known[order, 1], np.arange(len(views) + 1))
            for view, first, end in zip(views, ends, ends[1:]):
                if view.name in windows:
                    rows = order[first:end]
                    inside[rows] = view.sees(self.points[known[rows, 0]])
            known = known[inside]
        return replace(self, views=views, observations=known)

    def reduced(self, downscale, max_resolution=0):
        """The scene with smaller images; see `Camera.reduced`."""
        return replace(self, views=tuple(
            replace(v, camera=v.camera.reduced(downscale, max_resolution)) for v in self.views))

    def recentred(self):
        """The scene with its origin at the median point, so that float32 keeps its digits."""
        offset = np.median(self.points, axis=0)
        return replace(
            self, points=self.points - offset, offset=self.offset + offset,
            views=tuple(replace(v, camera=v.camera.shifted(offset)) for v in self.views))

    def normalised(self):
        """The scene in units of its extent: what is then computed in float32 is the same whatever
        unit the original coordinates have."""
        extent = self.extent
        return replace(
            self, points=self.points / extent, unit=self.unit * extent, views=tuple(
                replace(v, camera=replace(v.camera, translation=v.camera.translation / extent))
                for v in self.views))
