"""Frames of trees (io/models/tree.py) that fit neither the device nor host memory.

For each camera nodes are chosen by their distance. If their gaussians fit, they are drawn in one
piece, and stay on the device while a camera needs the same ones. Otherwise they are drawn in slabs
of depth (slabs.py), for which nodes are read as often as they are needed: the operating system
keeps what it has room for.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import SPLAT_REALS
from clsplat.device import Array, Device
from clsplat.io.models.tree import FIELDS, ORDER, Tree
from clsplat.rendering import slabs
from clsplat.rendering.pipeline import Frame, Renderer
from clsplat.rendering.project import LOW_PASS

# pixels that the mean sigma of a node may cover, by whether the renderer is antialiased (measured:
# up to there no view loses more than 0.2 dB). Levels that were trained may cover more
MOST_SIGMA_PIXELS = {False: 1.0, True: 0.14}
HOST_BYTES = 1 << 30  # of host memory, for what is drawn
AT_A_TIME = 0.5  # of these bytes for gaussians that are drawn at a time; the rest to sort all
GATHER_BYTES = 64  # for each gaussian that is drawn at a time: which node has it
PAIR_BYTES = 128  # likewise, where the device has the host's memory: pairs with tiles (measured)


def choose(tree: Tree, camera: Camera, pixels: float, near: float, low_pass: float = LOW_PASS) -> NDArray[np.intp]:
    """The nodes that a camera needs, ascending; together they replace all that it may see.

    They are the coarsest whose mean sigma covers at most `pixels` where they are nearest to the
    camera, or leaves.

    Parameters
    ----------
    tree : the model, in the world of the camera.
    camera : a pinhole.
    pixels : 0: leaves only.
    near : depth of the near plane, world units.
    low_pass : as for `pipeline.Renderer`.
    """
    nodes = tree.nodes
    seen = slabs.boxes_seen(nodes["low"], nodes["high"], nodes["largest"], camera, near, low_pass)
    nearest = np.clip(camera.position, nodes["usual_low"], nodes["usual_high"])
    distance = np.linalg.norm(nearest - camera.position, axis=1)
    is_enough = tree.is_leaf | (max(camera.focal) * nodes["sigma"] <= pixels * distance)
    # from the root, a level of children at a time
    reached, before = np.arange(len(nodes)) == len(nodes) - 1, np.zeros(len(nodes), bool)
    while (reached != before).any():
        before = reached
        reached = np.append((reached & seen & ~is_enough)[nodes["parent"][:-1]], True)
    return np.flatnonzero(reached & seen & is_enough)


class NodeParts:
    """Some nodes of a tree, by their numbers, as the parts of a model that a SlabRenderer draws;
    `count` : how many rows they have, which are numbered in this order."""

    def __init__(self, tree: Tree, nodes: NDArray[np.intp]) -> None:
        self._tree, self._nodes = tree, nodes
        self._firsts = np.append(0, np.cumsum(tree.nodes["count"][nodes].astype(np.int64)))
        self.count = int(self._firsts[-1])

    def seen(self, _camera: Camera, _near: float, _low_pass: float = LOW_PASS) -> list[slice]:
        """Slices of all rows: the nodes were chosen for the camera."""
        return [
            slice(begin, min(begin + slabs.PART_ROWS, self.count)) for begin in range(0, self.count, slabs.PART_ROWS)
        ]

    def read(self, name: str, rows: slice | NDArray[np.int64]) -> NDArray[np.float32]:
        """float32[M, *row shape]: a field of these rows."""
        if isinstance(rows, slice):
            first, end = np.searchsorted(self._firsts, (rows.start + 1, rows.stop)) - (1, 0)
            whole = np.concatenate([self._tree.read(node, name) for node in self._nodes[first:end]])
            return whole[rows.start - self._firsts[first] :][: rows.stop - rows.start]
        place = np.searchsorted(self._firsts, rows, side="right") - 1
        order = np.argsort(place, kind="stable")
        values = np.empty((len(rows), *FIELDS[name].row_shape(self._tree.sh_degree)), np.float32)
        for to in np.split(order, np.flatnonzero(np.diff(place[order])) + 1):
            node = place[to[0]]
            values[to] = self._tree.read(self._nodes[node], name)[rows[to] - self._firsts[node]]
        return values


class TreeRenderer:
    """Renders trees; a `ModelRenderer` whose rows are a Tree and whose camera stays as it is.

    Parameters
    ----------
    device, near, antialiased, background : as for `pipeline.Renderer`.
    tree : that will be drawn, in the world of its cameras.
    host_bytes : of host memory for what is drawn; on a device whose memory is the host's, for its
        arrays too. More is taken where the chosen nodes have more gaussians than a 32nd of this.
    limit : gaussians that are drawn at a time; None: as many as memory allows.
    """

    def __init__(
        self,
        device: Device,
        tree: Tree,
        near: float,
        antialiased: bool = False,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        host_bytes: float = HOST_BYTES,
        limit: int | None = None,
    ) -> None:
        self.device, self.near = device, near
        self._pixels = MOST_SIGMA_PIXELS[antialiased]
        self._limit = limit or max(
            1,
            min(
                slabs.gaussian_limit(device, tree.sh_degree),
                int(AT_A_TIME * host_bytes / _drawn_bytes(device, tree.sh_degree)),
            ),
        )
        settings = device, tree.sh_degree, near, antialiased, background
        self._renderer = Renderer(*settings)
        self._slabs = slabs.SlabRenderer(*settings, self._limit)
        self._chosen: NDArray[np.intp] = np.empty(0, np.intp)  # of what is on the device
        self._rows: dict[str, Array] = {}

    def pack(self, camera: Camera) -> Camera:
        """The camera as `render` expects it."""
        return camera

    def render(
        self,
        tree: Tree,
        camera: Camera,
        width: int,
        height: int,
        sh_degree: int,
        with_depth: bool = False,
        depth_percent: int = 0,
    ) -> Frame | slabs.SlabFrame:
        """Render a tree; arguments as for `pipeline.Renderer.render`."""
        chosen = choose(tree, camera, self._pixels, self.near, self._renderer.low_pass)
        parts = NodeParts(tree, chosen)
        if not 0 < parts.count <= self._limit:
            self._rows = {}
            return self._slabs.render(
                parts, self._slabs.pack(camera), width, height, sh_degree, with_depth, depth_percent
            )
        if not (self._rows and np.array_equal(chosen, self._chosen)):
            self._rows = {}  # gives its memory to the new ones
            self._rows = {name: self.device.upload(parts.read(name, slice(0, parts.count))) for name in ORDER}
            self._chosen = chosen
        return self._renderer.render(
            self._rows, self._renderer.pack(camera), width, height, sh_degree, with_depth, depth_percent=depth_percent
        )


def _drawn_bytes(device: Device, sh_degree: int) -> int:
    """Bytes of host memory that a gaussian takes while it is drawn."""
    widths = [field.width(sh_degree) for field in FIELDS.values()]
    on_device = 4 * (sum(widths) + SPLAT_REALS + slabs.INDICES) + PAIR_BYTES
    return 4 * max(widths) + GATHER_BYTES + on_device * device.is_cpu  # one field on its way there
