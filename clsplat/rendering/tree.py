"""Frames of trees (io/models/tree.py) that fit neither the device nor host memory.

For each camera nodes are chosen by their distance, and read where they are not in memory. If their
gaussians fit, they are drawn in one piece, and stay on the device while a camera needs the same
ones. Otherwise they are drawn in slabs of depth (slabs.py), for which nodes are read as often as
they are needed.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import SPLAT_REALS
from clsplat.device import Array, Device
from clsplat.gaussians import LEARNED
from clsplat.io.models.tree import ORDER, Tree, row_bytes
from clsplat.rendering.pipeline import Frame, Renderer
from clsplat.rendering.project import LOW_PASS
from clsplat.rendering.slabs import (
    INDICES,
    PART_ROWS,
    SlabFrame,
    SlabRenderer,
    boxes_seen,
    gaussian_limit,
)

# pixels that the mean sigma of a node may cover, by whether the renderer is antialiased (measured:
# up to there no view loses more than 0.2 dB). Levels that were trained may cover more
MOST_SIGMA_PIXELS = {False: 1.0, True: 0.14}
HOST_BYTES = 1 << 30  # of host memory, for the nodes that are kept and for what is drawn
CACHE_SHARE = 0.5  # of these bytes for the nodes; the rest for what is drawn at a time
ORDER_BYTES = 16  # for each gaussian of the chosen nodes, to sort those that do not fit
GATHER_BYTES = 64  # for each gaussian that is drawn at a time: which node has it
PAIR_BYTES = 128  # likewise, where the device has the host's memory: pairs with tiles (measured)


def choose(tree: Tree, camera: Camera, pixels: float, near: float, low_pass: float = LOW_PASS
           ) -> NDArray[np.intp]:
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
    nodes, (firsts, children) = tree.nodes, tree.children
    seen = boxes_seen(nodes["low"], nodes["high"], nodes["largest"], camera, near, low_pass)
    nearest = np.clip(camera.position, nodes["usual_low"], nodes["usual_high"])
    distance = np.linalg.norm(nearest - camera.position, axis=1)
    is_enough = tree.is_leaf | (max(camera.focal) * nodes["sigma"] <= pixels * distance)
    chosen, found = [], np.array([len(nodes) - 1])
    while len(found := found[seen[found]]):
        chosen.append(found[is_enough[found]])
        found = np.concatenate([np.empty(0, np.intp), *(
            children[firsts[node]:firsts[node + 1]] for node in found[~is_enough[found]])])
    return np.sort(np.concatenate([np.empty(0, np.intp), *chosen]))


class NodeCache:
    """Fields of nodes in host memory; those that were not used for the longest time leave first.

    Parameters
    ----------
    tree : whose nodes are read.
    limit : bytes that are kept at most.

    Attributes
    ----------
    read_bytes : that were read from the file so far.
    """

    def __init__(self, tree: Tree, limit: float) -> None:
        self.tree, self.limit = tree, limit
        self.read_bytes = self._bytes = 0
        self._kept: OrderedDict[tuple[int, str], NDArray[np.float32]] = OrderedDict()

    def get(self, node: int, name: str) -> NDArray[np.float32]:
        """The rows of a field of a node."""
        values = self._kept.pop((node, name), None)
        if values is None:
            values = self.tree.read(node, name)
            self.read_bytes += values.nbytes
            self._bytes += values.nbytes
            self.restrict(self.limit)
        self._kept[node, name] = values
        return values

    def restrict(self, limit: float) -> None:
        """Keep at most so many bytes from now on."""
        self.limit = limit
        while self._kept and self._bytes > limit:
            self._bytes -= self._kept.popitem(last=False)[1].nbytes


class NodeParts:
    """Some nodes of a tree as the parts of a model that a SlabRenderer draws.

    Parameters
    ----------
    cache : that reads the nodes.
    nodes : their numbers; their rows are numbered in this order.

    Attributes
    ----------
    count : how many rows they have.
    """

    def __init__(self, cache: NodeCache, nodes: NDArray[np.intp]) -> None:
        self._cache, self.nodes = cache, nodes
        self._firsts = np.append(0, np.cumsum(cache.tree.nodes["count"][nodes].astype(np.int64)))
        self.count = int(self._firsts[-1])

    def seen(self, _camera: Camera, _near: float, _low_pass: float = LOW_PASS) -> list[slice]:
        """Slices of all rows: the nodes were chosen for the camera."""
        groups, begin = [], 0
        for first, end in zip(self._firsts, self._firsts[1:]):
            if first > begin and end - begin > PART_ROWS:
                groups.append(slice(begin, int(first)))
                begin = int(first)
        return [*groups, slice(begin, self.count)] if self.count else groups

    def read(self, name: str, rows: slice | NDArray[np.int64]) -> NDArray[np.float32]:
        """float32[M, *row shape]: a field of these rows."""
        if isinstance(rows, slice):
            inside = slice(*np.searchsorted(self._firsts, (rows.start, rows.stop)))
            return np.concatenate([self._cache.get(int(node), name)
                                   for node in self.nodes[inside]])
        place = np.searchsorted(self._firsts, rows, side="right") - 1
        order = np.argsort(place, kind="stable")
        ends = np.searchsorted(place[order], np.arange(len(self.nodes) + 1))
        shape = next(field for field in LEARNED if field.name == name).row_shape(
            self._cache.tree.sh_degree)
        values = np.empty((len(rows), *shape), np.float32)
        for number in np.unique(place):
            to = order[ends[number]:ends[number + 1]]
            values[to] = self._cache.get(int(self.nodes[number]), name)[
                rows[to] - self._firsts[number]]
        return values


class TreeRenderer:
    """Renders trees; a `ModelRenderer` whose rows are a Tree.

    Parameters
    ----------
    device, near, antialiased, background : as for `pipeline.Renderer`.
    tree : that will be drawn, in the world of its cameras.
    bias : levels are as coarse as if everything were this many times as far away; 0: the finest.
    host_bytes : of host memory, for nodes that are kept and for what is drawn at a time; on a
        device whose memory is the host's, for its arrays too. More is taken where the chosen nodes
        have more gaussians than a 32nd of this.
    limit : gaussians that are drawn at a time; None: as many as memory allows.

    Attributes
    ----------
    cache : the nodes in memory.
    chosen : numbers of the nodes of the last frame.
    drawn, frames : gaussians of the chosen nodes, and frames, since the beginning.
    """

    def __init__(self, device: Device, tree: Tree, near: float, antialiased: bool = False,
                 background: Sequence[float] = (0.0, 0.0, 0.0), *, bias: float = 1.0,
                 host_bytes: float = HOST_BYTES, limit: int | None = None) -> None:
        self.device, self.near = device, near
        self._pixels = bias * MOST_SIGMA_PIXELS[antialiased]
        self._cache_bytes = CACHE_SHARE * host_bytes
        self.cache = NodeCache(tree, self._cache_bytes)
        self.limit = limit or max(1, min(
            gaussian_limit(device, tree.sh_degree), int(
                (1 - CACHE_SHARE) * host_bytes / _drawn_bytes(device, tree.sh_degree))))
        settings = device, tree.sh_degree, near, antialiased, background
        self._renderer = Renderer(*settings)
        self._slabs = SlabRenderer(*settings, self.limit)
        self.chosen: NDArray[np.intp] = np.empty(0, np.intp)
        self._rows: dict[str, Array] = {}
        self.drawn = self.frames = 0

    def pack(self, camera: Camera) -> Camera:
        """The camera as `render` expects it."""
        return camera

    def render(self, tree: Tree, camera: Camera, width: int, height: int, sh_degree: int,
               with_depth: bool = False) -> Frame | SlabFrame:
        """Render a tree; arguments as for `pipeline.Renderer.render`."""
        chosen = choose(tree, camera, self._pixels, self.near, self._renderer.low_pass)
        parts = NodeParts(self.cache, chosen)
        self.drawn, self.frames = self.drawn + parts.count, self.frames + 1
        is_same, self.chosen = np.array_equal(chosen, self.chosen), chosen
        is_whole = 0 < parts.count <= self.limit
        self.cache.restrict(self._cache_bytes - ORDER_BYTES * parts.count * (not is_whole))
        if not is_whole:
            self._rows = {}
            return self._slabs.render(parts, self._slabs.pack(camera), width, height, sh_degree,
                                      with_depth)
        if not (is_same and self._rows):
            self._rows = {}  # gives its memory to the new ones
            self._rows = {name: self.device.upload(parts.read(name, slice(0, parts.count)))
                          for name in ORDER}
        return self._renderer.render(self._rows, self._renderer.pack(camera), width, height,
                                     sh_degree, with_depth)


def _drawn_bytes(device: Device, sh_degree: int) -> int:
    """Bytes of host memory that a gaussian takes while it is drawn."""
    largest = max(4 * field.width(sh_degree) for field in LEARNED)  # on its way to the device
    on_device = row_bytes(sh_degree) + 4 * (SPLAT_REALS + INDICES) + PAIR_BYTES
    return largest + GATHER_BYTES + on_device * device.is_cpu
