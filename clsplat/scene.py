"""A scene: posed photos and a sparse point cloud, in a frame near the origin."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from clsplat.camera import Camera, scene_extent

NEAR_SHARE = 1 / 500  # of the extent: holds for scenes in any unit


@dataclass(frozen=True, eq=False)
class View:
    """One photo: its name within the scene, its camera, and where its pixels come from.

    source: a file path, or the encoded bytes of the image (packed scenes).
    """

    name: str
    camera: Camera
    source: Path | bytes


@dataclass(frozen=True, eq=False)
class Scene:
    """Views sorted by name, and sparse points.

    points: float64[N, 3]; colours: uint8[N, 3]; offset: float64[3], what was subtracted from the
    original world coordinates (`original = local + offset`); kept so that exports restore it;
    path: where it was read from; observations: int32[M, 2], rows (point, view) that say which view
    the sparse model saw a point in, each once, sorted; None where the file does not tell.
    """

    name: str
    views: tuple[View, ...]
    points: np.ndarray
    colours: np.ndarray
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    path: Path = Path()
    observations: np.ndarray | None = None

    @property
    def extent(self):
        """World units; see `camera.scene_extent`. Falls back to the cloud where cameras agree."""
        extent = scene_extent([view.camera for view in self.views])
        if extent > 0:
            return extent
        return 1.1 * float(np.linalg.norm(self.points - self.points.mean(0), axis=1).max())

    @property
    def near_plane(self):
        """World units: what is closer to a camera is not drawn."""
        return self.extent * NEAR_SHARE

    def split(self, test_every):
        """(train, test) tuples of views: every `test_every`-th view by name, from the first, is
        held out; 0 holds out none."""
        if test_every <= 0:
            return self.views, ()
        test = self.views[::test_every]
        return tuple(v for i, v in enumerate(self.views) if i % test_every), test

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
