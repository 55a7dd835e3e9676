"""What a partition looks at, in world coordinates: cameras, content, and who sees which point."""

from dataclasses import dataclass

import numpy as np

from clsplat.covisibility.neighbours import sightings
from clsplat.errors import InputError
from clsplat.partition.frame import ground_axes, quantiles, up_axis
from clsplat.region import Space, map_axes

BULK = (0.01, 0.99)  # quantiles between which the content lies that is no outlier
THINNEST = 0.02  # of the longest half side of an area: no side is shorter


@dataclass(frozen=True, eq=False)
class Site:
    """views: int[V], indices into scene.views of those that train; cameras: float64[V, 3].

    content: float64[M, 3], what is to be shared out among blocks, and weights: float64[M], the work
    that each is; points: float64[P, 3] of the sparse model, and rows point int[S], view int[S] (an
    index into `views`): which view sees which; rotation: float64[3, 3], rows u, v (along the
    ground) and up; bounds: (float64[2], float64[2]), low and high along u and v of the area of
    interest as the user set it, or None.
    """

    scene: object
    views: np.ndarray
    cameras: np.ndarray
    content: np.ndarray
    weights: np.ndarray
    points: np.ndarray
    point: np.ndarray
    view: np.ndarray
    rotation: np.ndarray
    bounds: tuple | None

    @classmethod
    def of(cls, scene, gaussians=None, views=None, up=None, bounds=None):
        """The Site of a Scene. Content is the centres of coarse Gaussians (in the scene's local
        frame), or the sparse points, weighing the number of views that see them.

        views: indices of the training views (None: all); up: three numbers, world, or None to find
        it; bounds: (x0, y0, x1, y1) on the map, see `Space.map`. Raises InputError.
        """
        views = np.arange(len(scene.views)) if views is None else np.asarray(views)
        chosen = [scene.views[index] for index in views]
        points, point, view = sightings(scene, chosen)
        points = world_of(scene, points)
        rotations = np.array([v.camera.rotation for v in chosen])
        cameras = world_of(scene, [v.camera.position for v in chosen])
        if gaussians is None:
            content, weights = points, np.bincount(point, minlength=len(points)).astype(float)
        else:
            content = world_of(scene, gaussians.positions)
            weights = np.isfinite(content).all(axis=1).astype(float)
        if not weights.any():
            raise InputError(f"{scene.name}: nothing to share out: no point is seen by a training "
                             "view; reconstruct the scene again, or train a coarse model first")
        up = up_axis(rotations, points) if up is None else np.array(up) / np.linalg.norm(up)
        if bounds is None:
            rotation = ground_axes(up, content, weights)
        else:
            bounds = np.array(bounds, np.float64).reshape(2, 2)
            rotation = np.stack([*map_axes(up), up])
        site = cls(scene, views, cameras, content, weights, points, point, view, rotation, bounds)
        if bounds is not None and not site.inside().any():
            low, high = site.bulk()
            raise InputError(
                f"{scene.name}: no points within the bounds {_words(*bounds)} of the map; most lie "
                f"within {_words(low[:2], high[:2])}: correct --bounds, or leave them out")
        return site

    def inside(self):
        """bool[M]: which content lies in the bounds, if there are any."""
        if self.bounds is None:
            return self.weights > 0
        along = self.content @ self.rotation[:2].T
        return ((along >= self.bounds[0]) & (along < self.bounds[1])).all(axis=1)

    def bulk(self, shares=(BULK, BULK)):
        """(low float64[3], high float64[3]) along u, v and up, world units: the bounds where there
        are any, else between these quantiles of the content along u and v; along up, of all that is
        there, cameras too."""
        along = self.content @ self.rotation.T
        up = np.concatenate([quantiles(along[:, 2], self.weights, BULK),
                             self.cameras @ self.rotation[2]])
        if self.bounds is not None:
            low, high = self.bounds
        else:
            low, high = np.transpose([quantiles(along[:, axis], self.weights, share)
                                      for axis, share in enumerate(shares)])
        return np.array([*low, up.min()]), np.array([*high, up.max()])

    def space(self, contracted=False, shares=(BULK, BULK), stretch=(1.0, 1.0)):
        """The Space whose area of interest is `bulk(shares)`, its sides along u and v multiplied by
        `stretch` where no bounds are set."""
        low, high = self.bulk(shares)
        half = (high - low) / 2
        if self.bounds is None:
            half[:2] *= stretch
        half = np.maximum(half, THINNEST * max(half.max(), np.finfo(float).tiny))
        return Space(self.rotation, (low + high) / 2 @ self.rotation, half, contracted)


def world_of(scene, points):
    """Original world coordinates float64[N, 3] of local ones."""
    return scene.offset + scene.unit * np.asarray(points, np.float64).reshape(-1, 3)


def _words(low, high):
    return " ".join(f"{value:.6g}" for value in (*low, *high))
