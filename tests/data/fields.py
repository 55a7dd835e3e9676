"""A made-up survey: points sampled over a rectangle, cameras above it, and the same scene moved."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.covisibility.source_views import visibility
from clsplat.partition.make import make_partition
from clsplat.partition.options import PartitionOptions
from clsplat.scene import Scene, View

LAX = {"least_views": 0, "least_gaussians": 0}  # nothing is starved
SIDES = np.array([30.0, 18.0])  # half of the rectangle's, world units


def field(seed=0, points=3000, cameras=60, tracks=True):
    """A Scene that knows its tracks: hills on a rectangle with z up, photographed from above and at
    an angle. Points thin out and a few are far off, as in a real model."""
    rng = np.random.default_rng(seed)
    ground = np.clip(rng.normal(0, 0.55, (points, 2)), -1, 1.1) * SIDES
    height = np.abs(rng.normal(0, 0.8, points))
    cloud = np.column_stack([ground, height])
    cloud[: points // 300] *= 40
    views = [View(f"{number:04d}", _camera(rng, tilt=0.7 * (number % 2)), b"") for number in range(cameras)]
    seen = np.array([v.sees(cloud) for v in views])
    seen &= rng.random(seen.shape) < 0.5
    observations = np.argwhere(seen.T).astype(np.int32) if tracks else None
    colours = rng.integers(0, 256, (points, 3)).astype(np.uint8)
    return Scene("field", tuple(views), cloud, colours, observations=observations)


def _camera(rng, tilt):
    position = np.array([*rng.uniform(-1, 1, 2) * SIDES, rng.uniform(9, 11)])
    turn = Rotation.from_euler("ZX", [rng.uniform(0, 2 * np.pi), np.pi + tilt])
    rotation = turn.as_matrix().T
    return Camera(64, 48, (60.0, 60.0), (32.0, 24.0), rotation, -rotation @ position)


def moved(scene, rotation, scale, shift):
    """The scene turned, scaled and shifted: x becomes scale * rotation @ x + shift. Its local frame
    is another too, as if it had been normalised."""
    unit, offset = 2.5, np.array([3.0, -2.0, 1.0])

    def place(x):
        return (scale * x @ rotation.T + shift - offset) / unit

    def turned(view):
        camera = view.camera
        turn = camera.rotation @ rotation.T
        return replace(view, camera=replace(camera, rotation=turn, translation=-turn @ place(camera.position)))

    return replace(scene, points=place(scene.points), unit=unit, offset=offset, views=tuple(map(turned, scene.views)))


def shuffled(scene, order):
    """The scene with its points in another order, int[N]."""
    place = np.argsort(order)
    rows = scene.observations
    if rows is not None:
        rows = np.column_stack([place[rows[:, 0]], rows[:, 1]]).astype(np.int32)
        rows = rows[np.lexsort(rows.T[::-1])]
    return replace(scene, points=scene.points[order], colours=scene.colours[order], observations=rows)


def world(scene):
    """The scene's points in world coordinates."""
    return scene.offset + scene.unit * scene.points


def cut(scene, method, grid=(3, 2), gaussians=None, views=None, drop=None, **changes):
    """The Partition of a scene by a method, with changed options; without gaussians, of the points
    that some view sees."""
    views = np.arange(len(scene.views)) if views is None else views
    if gaussians is None:
        _, seen, _ = visibility(scene, [scene.views[index] for index in views])
        gaussians = SimpleNamespace(positions=scene.points[np.unique(seen)])
    return make_partition(
        scene, PartitionOptions(method=method, grid=grid, **{**LAX, **changes}), gaussians, views, drop
    )
