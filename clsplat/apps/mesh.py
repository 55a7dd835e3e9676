"""The mesh of a run: the depths of its views, fused in a volume of signed distances, as triangles.

The volume has bricks only where views show a surface, and only as many at a time as memory holds;
a view is rendered anew for each such batch that it sees.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy
import skimage
from numpy.typing import NDArray

from clsplat.apps.map_grid import ground_resolution
from clsplat.apps.models import in_original
from clsplat.apps.orthophoto import HOLE, LEAST_VIEWS, MEDIAN
from clsplat.camera import Camera
from clsplat.constants import BRICK_CELLS, COARSEST_PIXEL
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run, shown
from clsplat.io.models.mesh import Mesh
from clsplat.io.models.values import morton_order, to_bytes
from clsplat.mesh.decimate import decimated, edges_of
from clsplat.mesh.signed_distance import Volume, brick_bytes
from clsplat.rendering.blend import Blended
from clsplat.rendering.slabs import boxes_seen, open_model
from clsplat.scene import Scene
from clsplat.training.progress import SilentProgress

FIRST = 75  # per cent of the light that still passes: a median depth far behind is unsure
TRUNCATION = 4  # voxels
SKIPPED = 4  # the side of the pixels, in those of a photo, in which surfaces are looked for
LEAST_WEIGHT = 1.0  # of a sample, by all views; of one that is sure of its depth it is 1
LEAST_DISTANCE = 1e-6  # in place of 0, at which several vertices would be one
BATCH_BYTES = 1 << 30  # of a volume
BATCH_SHARE = 0.25  # of a device's memory, at most
MOST_BRICKS = 1 << 19
ISLAND = 400.0  # voxels squared: smaller surfaces, connected with no other, are left out
Bricks = NDArray[np.int32]  # [B, 3], see `Volume`


@dataclass(frozen=True, eq=False)
class Pieces:
    """Triangles of a part of the volume.

    Attributes
    ----------
    vertices : float64[N, 3], in voxels from the volume's origin.
    colours : float64[N, 3], 0 to 255.
    triangles : int[M, 3], vertices.
    shared : bool[N], vertices that another part has, too.
    """

    vertices: NDArray[np.float64]
    colours: NDArray[np.float64]
    triangles: NDArray[np.integer]
    shared: NDArray[np.bool_]

    @classmethod
    def joined(cls, some: list[Pieces]) -> Pieces:
        """The triangles of all, in which a vertex that several share is one."""
        firsts = np.cumsum([0, *(len(each.vertices) for each in some)])
        vertices, colours, shared = (
            np.concatenate([getattr(each, name) for each in some]) for name in ("vertices", "colours", "shared")
        )
        triangles = np.concatenate([each.triangles + first for each, first in zip(some, firsts)])
        rows = np.flatnonzero(shared)
        _, first, same = np.unique(vertices[rows], axis=0, return_index=True, return_inverse=True)
        to = np.arange(len(vertices))
        to[rows] = rows[first[same.reshape(-1)]]
        return cls(vertices, colours, to[triangles], shared)._used()

    def _used(self) -> Pieces:
        """The same without vertices of no triangle."""
        used = np.zeros(len(self.vertices), bool)
        used[self.triangles] = True
        return Pieces(self.vertices[used], self.colours[used], (np.cumsum(used) - 1)[self.triangles], self.shared[used])

    def without_islands(self) -> Pieces:
        """The same without surfaces smaller than ISLAND."""
        count, (a, b, c) = len(self.vertices), self.triangles.T
        links = scipy.sparse.coo_array(
            (np.ones(2 * len(a)), (np.concatenate([a, a]), np.concatenate([b, c]))), (count, count)
        )
        parts, of = scipy.sparse.csgraph.connected_components(links, directed=False)
        first, second, third = (self.vertices[each] for each in (a, b, c))
        area = np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2
        sizes = np.bincount(of[a], area, parts)
        large = sizes >= min(ISLAND, sizes.max(initial=0))
        return Pieces(self.vertices, self.colours, self.triangles[large[of[a]]], self.shared)._used()


class Views:
    """The views of a scene, as a run shows them, in the frame of its model.

    Attributes
    ----------
    cameras : of the views.
    near : the depth of the near plane, units of the original coordinates.
    offset : float64[3], original coordinates of the origin of the frame.
    """

    def __init__(self, device: Device, run: Run, scene: Scene) -> None:
        model, options = shown(run.finished_model, run.path), run.options
        self.offset, self._degree = model.offset, model.sh_degree
        self.cameras = [camera.shifted(model.offset) for camera in in_original(scene)]
        self.near = scene.near(options.near) * scene.unit
        self._renderer, self._rows = open_model(device, model, self.near, options.antialiased, options.background)

    def blended(self, camera: Camera, percent: int) -> Blended:
        """What a camera sees, with the depths at which so many per cent of the light still pass."""
        return self._renderer.render(
            self._rows,
            self._renderer.pack(camera),
            camera.width,
            camera.height,
            self._degree,
            with_depth=True,
            depth_percent=percent,
        ).blended

    def add_to(self, volume: Volume, chosen: NDArray[np.integer], camera: Camera) -> None:
        """Add what a camera sees to bricks of a volume."""
        half, first = (self.blended(camera, percent) for percent in (MEDIAN, FIRST))
        volume.add(chosen, camera, self.near, half.depth, first.depth, half.transmittance, half.image)


def run_mesh(
    run: Run, scene: Scene, device: Device, voxel: float | None = None, progress: SilentProgress | None = None
) -> Mesh:
    """The surface of a run as triangles, in original coordinates.

    Parameters
    ----------
    run, scene : finished, and its scene, whose views are rendered.
    device : an open device.
    voxel : the finest detail, units of the original coordinates; None: the size of a pixel of the
        photos at the points that they show.
    progress : is given what is done.

    Raises
    ------
    InputError : views show no surface, or the volume would have too many voxels.
    """
    progress = progress or SilentProgress()
    voxel = voxel or ground_resolution(scene)
    views = Views(device, run, scene)
    bricks = _bricks_near_surface(views, voxel, progress)
    if not len(bricks):
        raise InputError(
            f"{run.path}: no two views show a surface whose pixels are smaller than "
            f"{COARSEST_PIXEL} voxels of {voxel:g}; give a larger --voxel, or train "
            "longer"
        )
    bricks = bricks[morton_order(bricks.astype(np.float64))]
    size = max(
        1,
        int(min(BATCH_BYTES, BATCH_SHARE * device.handle.global_mem_size, device.largest_buffer) / brick_bytes(device)),
    )
    batches = [bricks[begin : begin + size] for begin in range(0, len(bricks), size)]
    seen = [[np.flatnonzero(_sees(views, camera, batch, voxel)) for camera in views.cameras] for batch in batches]
    total, done, pieces = sum(len(rows) > 0 for each in seen for rows in each), 0, []
    for batch, chosen in zip(batches, seen):
        volume = Volume(device, batch, voxel, TRUNCATION * voxel)
        for camera, rows in zip(views.cameras, chosen):
            if len(rows):
                views.add_to(volume, rows, camera)
                device.finish()
                done += 1
                progress.count("fusing view", done, total)
        progress.phase("making triangles")
        found = list(_surfaces(volume.download(), batch))
        if found:
            pieces.append(_fewer(Pieces.joined(found), batch, bricks))
    progress.phase("joining triangles")
    whole = Pieces.joined(pieces).without_islands() if pieces else None
    if whole is None or not len(whole.triangles):
        raise InputError(
            f"{run.path}: its views agree on no surface in voxels of {voxel:g}; give another --voxel, or train longer"
        )
    return Mesh(whole.vertices * voxel + views.offset, to_bytes(whole.colours), whole.triangles.astype(np.int32), voxel)


def _bricks_near_surface(views: Views, voxel: float, progress: SilentProgress) -> Bricks:
    """The bricks in which at least LEAST_VIEWS views show a surface, or within the truncation."""
    side, found = BRICK_CELLS * voxel, [np.zeros((0, 3), np.int64)]
    for number, whole in enumerate(views.cameras, 1):
        camera = whole.resized(*(max(1, size // SKIPPED) for size in (whole.width, whole.height)))
        blended = views.blended(camera, MEDIAN)
        depth = blended.depth.download().astype(np.float64)
        usable = (
            (blended.transmittance.download() <= HOLE)
            & (depth > views.near)
            & (depth <= COARSEST_PIXEL * voxel * whole.focal[0])
        )
        row, column = np.nonzero(usable)
        rays = np.stack(
            [
                (column + 0.5 - camera.centre[0]) / camera.focal[0],
                (row + 0.5 - camera.centre[1]) / camera.focal[1],
                np.ones(len(row)),
            ],
            1,
        )
        ends = [
            (rays * (depth[usable] + away)[:, None] - camera.translation) @ camera.rotation
            for away in np.linspace(-1, 1, 3) * TRUNCATION * voxel
        ]
        found.append(np.unique(np.floor(np.concatenate(ends) / side).astype(np.int64), axis=0))
        progress.count("looking for surfaces: view", number, len(views.cameras))
    bricks, counts = np.unique(np.concatenate(found), axis=0, return_counts=True)
    shown_by_several: Bricks = bricks[counts >= LEAST_VIEWS].astype(np.int32)
    if len(shown_by_several) > MOST_BRICKS:
        raise InputError(
            f"--voxel {voxel:g}: the volume would have {len(shown_by_several):,} "
            f"bricks of {BRICK_CELLS} voxels along a side, more than "
            f"{MOST_BRICKS:,}; give a larger one"
        )
    return shown_by_several


def _sees(views: Views, camera: Camera, bricks: Bricks, voxel: float) -> NDArray[np.bool_]:
    """bool[B]: whether a camera may see a brick."""
    low, high = (BRICK_CELLS * voxel * (bricks.astype(np.float64) + end) for end in (0, 1))
    return boxes_seen(low, high, np.zeros(len(bricks)), camera, views.near)


def _surfaces(sums: NDArray[np.floating], bricks: Bricks) -> Iterator[Pieces]:
    """The triangles of each brick in whose cells a surface is known (marching cubes, as Lewiner et
    al. 2003)."""
    corners = list(np.ndindex(2, 2, 2))
    for place, (total, weight, views, *colours) in zip(bricks, sums.swapaxes(0, 1)):
        known = (weight >= LEAST_WEIGHT) & (views >= LEAST_VIEWS)
        distance = np.where(known, total / np.maximum(weight, 1e-6), 1).astype(np.float32)
        distance[distance == 0] = LEAST_DISTANCE
        if not distance.min() < 0 < distance.max():
            continue
        cells = np.zeros(known.shape, bool)  # by the last of their corners
        cells[1:, 1:, 1:] = np.logical_and.reduce(
            [known[i : BRICK_CELLS + i, j : BRICK_CELLS + j, k : BRICK_CELLS + k] for i, j, k in corners]
        )
        try:
            found, triangles, *_ = skimage.measure.marching_cubes(distance, 0, mask=cells)
        except RuntimeError:  # it found none
            continue
        *tints, near = (scipy.ndimage.map_coordinates(each, found.T, order=1) for each in colours)
        shared = ((found == 0) | (found == BRICK_CELLS)).any(axis=1)
        yield Pieces(
            found.astype(np.float64) + BRICK_CELLS * place,
            255 * np.stack(tints, axis=1) / np.maximum(near, 1e-6)[:, None],
            triangles,
            shared,
        )


def _fewer(pieces: Pieces, batch: Bricks, bricks: Bricks) -> Pieces:
    """The triangles of a batch decimated, but for vertices that other batches have, too."""
    first = bricks.min(axis=0) - 1

    def keys(places: NDArray[np.integer]) -> NDArray[np.int64]:
        x, y, z = (places - first).T.astype(np.int64)
        key: NDArray[np.int64] = (x << 42) + (y << 21) + z
        return key

    others = np.setdiff1d(keys(bricks), keys(batch))
    shared = np.zeros(len(pieces.vertices), bool)
    for corner in np.ndindex(2, 2, 2):  # the bricks around a vertex
        beside = pieces.vertices + 1e-3 * (2 * np.array(corner) - 1)
        shared |= np.isin(keys(np.floor(beside / BRICK_CELLS).astype(np.int64)), others)
    return Pieces(*decimated(pieces.vertices, pieces.colours, pieces.triangles, shared))


def open_edges(mesh: Mesh) -> int:
    """How many edges of a mesh are not between two triangles; of a watertight one none."""
    return int((edges_of(mesh.triangles)[1] != 2).sum())
