"""Reads the sparse points of a project in OPF: glTF with buffers in files beside it.

Format: https://pix4d.github.io/opf-spec/specification/point_cloud.html, a part of glTF 2.0. A
node's matrix (column-major) leads from its points to glTF's axes, in which y is up; OPF's have z
up. The extension OPF_mesh_primitive_matches lists the photos that show a point: a packed pair of 40
bits (the first of its matches) and 24 bits (their number), and a photo for each match.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from clsplat.io.fields import numbers, text
from clsplat.io.models.gltf import accessor
from clsplat.io.reason import reason
from clsplat.io.records import object_of
from clsplat.io.regular import open_regular, read_regular
from clsplat.io.scenes.posed import Cloud

MATCHES = "OPF_mesh_primitive_matches"
Z_UP = np.array([(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)])  # from axes with y up
OFFSET_BITS = 40  # of the first of a point's matches


def read_points(path: Path, cameras: Sequence[int]) -> Cloud | None:
    """Read the points of a glTF file; None if it has none.

    Parameters
    ----------
    cameras : the ids of the photos, in the order of observations.

    Raises
    ------
    ValueError : if a file is damaged; OSError if one is missing.
    """
    try:
        document = object_of(read_regular(path))
        nodes = document["scenes"][document.get("scene", 0)].get("nodes", [])
        clouds = [_node(path.parent, document, document["nodes"][node], cameras) for node in nodes]
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError) as error:
        raise ValueError(f"{path.name[:80]}: {reason(error)}") from None
    positions = [cloud.positions for cloud in clouds]
    if not sum(map(len, positions)):
        return None
    begins = np.cumsum([0, *map(len, positions)])
    colours = [cloud.colours for cloud in clouds if cloud.colours is not None]
    observations = [cloud.observations + (begin, 0) for cloud, begin in zip(clouds, begins)
                    if cloud.observations is not None]
    return Cloud(np.concatenate(positions),
                 np.concatenate(colours) if len(colours) == len(clouds) else None,
                 np.concatenate(observations) if len(observations) == len(clouds) else None)


def _node(folder: Path, document: dict[str, Any], node: Mapping[str, Any], cameras: Sequence[int]
          ) -> Cloud:
    """The points of a node of the scene."""
    def content(buffer: dict[str, Any]) -> NDArray[np.uint8]:
        uri = unquote(text(buffer.get("uri"), "the uri of a buffer"))
        if uri.startswith("data:"):
            raise ValueError("a buffer is not in a file")
        with open_regular(folder / uri) as file:
            return np.memmap(file, np.uint8, "r")

    def values(number: int, width: int, kind: str) -> NDArray[Any]:
        found = accessor(document, number, width, content)
        if found.dtype != kind:
            raise ValueError(f"accessor {number} is not of the right component type")
        return found

    primitive, = document["meshes"][node["mesh"]]["primitives"]
    attributes, extensions = primitive["attributes"], primitive.get("extensions", {})
    matrix = numbers(node.get("matrix", np.eye(4).ravel().tolist()), 16, "matrix")
    matrix = matrix.reshape(4, 4, order="F")
    local = values(attributes["POSITION"], 3, "<f4")
    if not np.isfinite(local).all():
        raise ValueError("a position is not finite")
    positions = (local.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]) @ Z_UP.T
    colours = observations = None
    if "COLOR_0" in attributes:
        colours = np.ascontiguousarray(values(attributes["COLOR_0"], 4, "u1")[:, :3])
        if len(colours) != len(positions):
            raise ValueError("there are more or less colours than points")
    if MATCHES in extensions:
        matches = extensions[MATCHES]
        ranges = values(matches["pointIndexRanges"], 2, "<u4")
        if len(ranges) != len(positions):
            raise ValueError("there are more or less ranges of matches than points")
        observations = _observations(matches["cameraUids"], values(
            matches["cameraIds"], 1, "<u4")[:, 0], ranges, cameras)
    return Cloud(positions, colours, observations)


def _observations(uids: Sequence[object], indices: NDArray[Any], ranges: NDArray[Any],
                  cameras: Sequence[int]) -> NDArray[np.int64]:
    """int64[M, 2], rows (point, photo), of the ids of cameras, their indices and packed ranges."""
    packed = ranges[:, 0].astype(np.uint64) | ranges[:, 1].astype(np.uint64) << np.uint64(32)
    begins = (packed & np.uint64((1 << OFFSET_BITS) - 1)).astype(np.int64)
    counts = (packed >> np.uint64(OFFSET_BITS)).astype(np.int64)
    if (begins + counts > len(indices)).any() or counts.sum() > len(indices):
        raise ValueError("the ranges of matches are beyond their number")
    if len(indices) and indices.max() >= len(uids):
        raise ValueError("a match has a camera that is missing")
    place = {uid: row for row, uid in enumerate(cameras)}
    photo_of = np.array([place.get(uid if isinstance(uid, int) else -1, -1) for uid in uids],
                        np.int64)
    points = np.repeat(np.arange(len(ranges)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    photos = photo_of[indices[begins.repeat(counts) + within]] if len(points) else points
    rows: NDArray[np.int64] = np.stack([points, photos], axis=1)[photos >= 0]
    return rows
