"""A scene: posed photos and a sparse point cloud, in coordinates near the origin."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera, Lens
from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.placement.corrections import Correction
from clsplat.placement.first_view import first_view
from clsplat.placement.up import UP, Vertical

if TYPE_CHECKING:
    from typing_extensions import Self


NEAR_SHARE = 1 / 500  # of the extent, so that it suits scenes in any unit
# below this share of the distance of the points (or with positions that differ only by rounding),
# the distance between cameras does not tell the scene's size: half a pixel then is half the depth
# at a focal length of 1000
LEAST_PARALLAX = 1e-3


@dataclass(frozen=True, eq=False)
class View:
    """One photo of a scene.

    Attributes
    ----------
    name : of the photo within the scene.
    camera : of the photo; its size may be smaller than the photo's.
    source : a file path, the bytes of an encoded image, or its pixels in sRGB: uint8, uint16 or
        float32 (0 to 1) [H, W], [H, W, 3] or with alpha [H, W, 4].
    lens : of the photo as it is stored, if it is to be undistorted.
    mask : an image in which dark pixels mark those of the stored photo that do not count, as
        `source`; None: all count.
    transparent : whether transparent pixels of the photo do not count.
    depth : the file of its depth map (io/photos/depth.py); None: it has none.
    quarter_turns : how many clockwise quarter turns show the photo upright, by its EXIF.
    weighed : whether a training may leave out pixels of the photo (training/robust.py).
    levels : 16-bit samples that become black and white; None: 0 and 65535.
    """

    name: str
    camera: Camera
    source: Path | bytes | NDArray[Any]
    lens: Lens | None = None
    mask: Path | bytes | NDArray[Any] | None = None
    transparent: bool = False
    depth: Path | None = None
    quarter_turns: int = 0
    weighed: bool = False
    levels: tuple[float, float] | None = None

    @property
    def may_have_mask(self) -> bool:
        """Whether a mask, its alpha or its lens may leave out pixels."""
        return self.mask is not None or self.transparent or self.lens is not None

    def sees(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which points float64[N, 3], local, lie in front of the camera and within the image,
        occluded or not, bool[N]."""
        return self.camera.shows(points)

    def __repr__(self) -> str:
        return f"<clsplat.View {self.name!r}: {self.camera.width} x {self.camera.height}>"


@dataclass(frozen=True, eq=False)
class Scene:
    """Photos with their cameras and a sparse point cloud, in local coordinates near the origin.

    Original coordinates are `offset + unit * local`.

    Attributes
    ----------
    name : of its folder or file.
    views : the photos with their cameras, sorted by name.
    points : float64[N, 3], local.
    colours : uint8[N, 3], of the points.
    offset, unit : float64[3] and a number, from local to original coordinates.
    path : the folder or file from which it was read.
    observations : int32[M, 2], the points that the sparse model saw in each view: distinct rows
        (point, view), sorted; None if the file does not tell.
    held_out : names of the test views, if the data set defines them; otherwise None.
    notes : messages for the user about parts of the files that are not used or were interpreted.
    georeference : where the original coordinates lie on the earth; None: unknown.
    given_up : float64[3], the unit vector that points up, if the files or the user tell; None: it
        is estimated, see `up`.
    """

    name: str
    views: tuple[View, ...]
    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    path: Path = Path()
    observations: NDArray[np.int32] | None = None
    unit: float = 1.0
    held_out: frozenset[str] | None = None
    notes: tuple[str, ...] = ()
    georeference: Georeference | None = None
    given_up: NDArray[np.float64] | None = None

    @cached_property
    def up(self) -> NDArray[np.float64]:
        """float64[3], the unit vector that points up: the one that was given, else the z axis of a
        georeferenced scene, else an estimate from the cameras and points."""
        if self.given_up is not None:
            return self.given_up
        if self.georeference is not None:
            return UP.copy()
        rotations = np.array([camera.rotation for camera in self._upright])
        return Vertical.by_cameras(rotations, self.points).up

    @cached_property
    def first_view(self) -> Camera:
        """The camera, in local coordinates, from which a viewer should first look: obliquely from
        above for aerial photos, facing north in a georeferenced scene, else that of a photo."""
        north = None if self.georeference is None else np.array([0.0, 1.0, 0.0])
        camera = first_view(self._upright, self.points, self.up, north)
        return replace(camera, offset=self.offset)

    @property
    def _upright(self) -> list[Camera]:
        """The cameras of the photos as they are shown, not as they are stored."""
        return [view.camera.turned(view.quarter_turns) for view in self.views]

    def corrected(self, corrections: Mapping[str, Correction]) -> Self:
        """The scene with corrected poses of some views, by name, in its units."""
        views = (
            replace(view, camera=corrections[view.name].applied(view.camera)) if view.name in corrections else view
            for view in self.views
        )
        return replace(self, views=tuple(views), given_up=self.up)

    def with_up(self, up: ArrayLike) -> Self:
        """The same scene, in which a direction points up.

        Parameters
        ----------
        up : float[3], of any length.

        Raises
        ------
        clsplat.ClsplatError : if it has no direction.
        """
        vector = np.asarray(up, np.float64)
        length = float(np.linalg.norm(vector))
        if vector.shape != (3,) or not 0 < length < np.inf:
            raise InputError(f"up {vector.tolist()}: is no direction; give one such as 0 0 1")
        return replace(self, given_up=vector / length)

    @property
    def extent(self) -> float:
        """The scene's size, world units: 1.1 times the largest distance of a camera from the mean
        camera position (Kerbl et al. 2023); the distance of the points if all cameras have the same
        position. Learning rates of positions and sizes in densification scale with it."""
        cameras, points = self._sizes
        return cameras if self.parallax >= LEAST_PARALLAX else points

    @property
    def parallax(self) -> float:
        """How far apart the cameras are, as a multiple of the distance of the points from them."""
        cameras, points = self._sizes
        return cameras / max(points, np.finfo(float).tiny)

    @cached_property
    def _sizes(self) -> tuple[float, float]:
        """The extent of the cameras, and the median distance of a point from their mean."""
        positions = np.array([view.camera.position for view in self.views])
        middle = positions.mean(axis=0)
        return (
            1.1 * float(np.linalg.norm(positions - middle, axis=1).max()),
            float(np.median(np.linalg.norm(self.points - middle, axis=1))),
        )

    @property
    def near_plane(self) -> float:
        """The default depth of the near plane, world units: 1/500 of the extent."""
        return self.extent * NEAR_SHARE

    def near(self, requested: float) -> float:
        """The depth of the near plane in the units of this scene; `requested` is the option `near`
        in original units, 0: `near_plane`."""
        return requested / self.unit or self.near_plane

    def split(self, test_every: int, test_offset: int = 0) -> tuple[tuple[View, ...], tuple[View, ...]]:
        """The training views and the held-out views.

        Parameters
        ----------
        test_every : every test_every-th view by name is held out, unless the data set defines the
            test views (`held_out`); 0: none.
        test_offset : how many views come before the first one that is held out.

        Returns
        -------
        A pair of tuples of views, (train, test).
        """
        if test_every <= 0:
            return self.views, ()
        held_out = self.held_out
        if held_out is None:
            held_out = frozenset(view.name for view in self.views[test_offset::test_every])
        return (
            tuple(v for v in self.views if v.name not in held_out),
            tuple(v for v in self.views if v.name in held_out),
        )

    def part(self, indices: Iterable[int]) -> Self:
        """The scene with some of its views, by their indices, and the points that these see."""
        chosen = sorted(indices)
        views, known = tuple(self.views[i] for i in chosen), self.observations
        if known is None:
            seen = sum((view.sees(self.points) for view in views), np.zeros(len(self.points), bool))
        else:
            point, view = known[np.isin(known[:, 1], chosen)].T
            seen = np.bincount(point, minlength=len(self.points)) > 0
            known = np.stack([np.cumsum(seen)[point] - 1, np.searchsorted(chosen, view)], axis=1).astype(np.int32)
        return replace(
            self,
            views=views,
            points=self.points[seen],
            colours=self.colours[seen],
            observations=known,
            given_up=self.up,
        )

    def cropped(self, windows: dict[str, tuple[int, int, int, int]]) -> Self:
        """The scene with views cropped to parts of their photos, by name (left, top, right, bottom,
        in pixels), and with observations only in these."""
        views = tuple(
            replace(v, camera=v.camera.cropped(*windows[v.name])) if v.name in windows else v for v in self.views
        )
        known = self.observations
        if known is not None:
            inside = np.ones(len(known), bool)
            for view, rows in zip(views, rows_by_view(known[:, 1], len(views))):
                if view.name in windows:
                    inside[rows] = view.sees(self.points[known[rows, 0]])
            known = known[inside]
        return replace(self, views=views, observations=known)

    def reduced(self, downscale: float, max_resolution: float = 0) -> Self:
        """The scene with smaller images.

        Parameters
        ----------
        downscale : width and height are divided by this.
        max_resolution : pixels, the longest side that a photo may have after this; 0: any.
        """
        return replace(
            self, views=tuple(replace(v, camera=v.camera.reduced(downscale, max_resolution)) for v in self.views)
        )

    def recentred(self) -> Self:
        """The scene with its origin at the median point, for the precision of float32."""
        offset = np.median(self.points, axis=0)
        return replace(
            self,
            points=self.points - offset,
            offset=self.offset + offset,
            views=tuple(replace(v, camera=v.camera.shifted(offset)) for v in self.views),
        )

    def normalised(self) -> Self:
        """The scene in units of its extent, so that computations in float32 do not depend on the
        unit of the original coordinates."""
        extent = self.extent
        return replace(
            self,
            points=self.points / extent,
            unit=self.unit * extent,
            given_up=self.up,
            views=tuple(
                replace(v, camera=replace(v.camera, translation=v.camera.translation / extent)) for v in self.views
            ),
        )

    def __repr__(self) -> str:
        return f"<clsplat.Scene {self.name!r}: {len(self.views)} views, {len(self.points):,} points>"


def rows_by_view(view: NDArray[np.integer], views: int) -> list[NDArray[np.intp]]:
    """For each of so many views the rows in which `view` int[M] names it, in their order."""
    # numpy sorts numbers of 16 bits by radix, in a fourth of the time
    order = np.argsort(view.astype(np.uint16) if views <= 1 << 16 else view, kind="stable")
    return np.split(order, np.cumsum(np.bincount(view, minlength=views))[:-1])
