"""Reads the sparse points of a project in OPF: glTF with buffers in files beside it.

Format: https://pix4d.github.io/opf-spec/specification/point_cloud.html, a part of glTF 2.0. A
node's matrix (column-major) leads from its points to glTF's axes, in which y is up; OPF's have z
up. The extension OPF_mesh_primitive_matches tells which photos show a point: a packed pair of 40
bits (the first of its matches) and 24 bits (their number), and a photo for each match.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from clsplat.io.fields import numbers
from clsplat.io.reason import reason
from clsplat.io.records import object_of
from clsplat.io.regular import open_regular, read_regular
from clsplat.io.scenes.cloud import Cloud

FLOAT, UINT, UBYTE = 5126, 5125, 5121  # glTF's numbers of component types
KINDS: dict[int, np.dtype[Any]] = {
    FLOAT: np.dtype("<f4"), UINT: np.dtype("<u4"), UBYTE: np.dtype("u1")}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
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
        table = _Gltf(path)
        parts = [_node(table, node) for node in table.nodes()]
        positions = [position for position, _, _ in parts]
        if not sum(map(len, positions)):
            return None
        colours = [colour for _, colour, _ in parts if colour is not None]
        matches = [match for _, _, match in parts if match is not None]
        begins = np.cumsum([0, *map(len, positions)])
        observations = [_observations(match, cameras) + (begin, 0)
                        for match, begin in zip(matches, begins)]
        return Cloud(
            np.concatenate(positions),
            np.concatenate(colours) if len(colours) == len(parts) else None,
            np.concatenate(observations) if len(matches) == len(parts) else None)
    except (ValueError, TypeError, LookupError, OverflowError) as error:
        raise ValueError(f"{path.name[:80]}: {reason(error)}") from None


class _Gltf:
    """A glTF file and its buffers."""

    def __init__(self, path: Path) -> None:
        self.folder, self.table = path.parent, object_of(read_regular(path))

    def entries(self, key: str) -> list[Any]:
        value = self.table.get(key, [])
        if not isinstance(value, list):
            raise ValueError(f"{key} is not a list")
        return value

    def entry(self, key: str, index: object) -> dict[str, Any]:
        """An object of a list by its index."""
        values = self.entries(key)
        if type(index) is not int or not 0 <= index < len(values):
            raise ValueError(f"{key} has no element {str(index)[:20]}")
        value = values[index]
        if not isinstance(value, dict):
            raise ValueError(f"{key} {index} is not an object")
        return value

    def nodes(self) -> list[dict[str, Any]]:
        """The nodes of the scene."""
        scene = self.entry("scenes", self.table.get("scene", 0))
        indices = scene.get("nodes", [])
        if not isinstance(indices, list):
            raise ValueError("nodes is not a list")
        return [self.entry("nodes", index) for index in indices]

    def array(self, index: object, kind: str, components: Sequence[int]) -> NDArray[Any]:
        """The array [N, width] of an accessor, whose type and components must be these."""
        accessor = self.entry("accessors", index)
        if accessor.get("type") != kind or accessor.get("componentType") not in components:
            raise ValueError(f"accessor {index} is not {kind} of the right component type")
        dtype, width = KINDS[accessor["componentType"]], WIDTHS[kind]
        if "sparse" in accessor or accessor.get("byteOffset"):
            raise ValueError(f"accessor {index} is sparse or interleaved")
        view = self.entry("bufferViews", accessor.get("bufferView"))
        buffer = self.entry("buffers", view.get("buffer"))
        count, begin = _count(accessor, "count"), _count(view, "byteOffset", 0)
        size = count * width * dtype.itemsize
        uri = buffer.get("uri")
        if not isinstance(uri, str) or "\0" in unquote(uri) or uri.startswith("data:"):
            raise ValueError("a buffer is not in a file")
        path = self.folder / unquote(uri)
        with open_regular(path) as file:
            if begin + size > file.seek(0, 2):
                raise ValueError(f"{path.name[:80]} is cut short")
            file.seek(begin)
            data = file.read(size)
        values: NDArray[Any] = np.frombuffer(data, dtype).reshape(count, width)
        return values


def _count(table: Mapping[str, Any], key: str, default: int = -1) -> int:
    value = table.get(key, default)
    if type(value) is not int or not 0 <= value < 1 << 48:
        raise ValueError(f"{key} is not a number of bytes or elements")
    return value


Part = tuple[NDArray[np.float64], NDArray[np.uint8] | None,
             tuple[list[Any], NDArray[Any], NDArray[Any]] | None]


def _node(table: _Gltf, node: Mapping[str, Any]) -> Part:
    """Positions, colours and matches (ids of cameras, their indices, packed ranges) of a node."""
    mesh = table.entry("meshes", node.get("mesh"))
    primitives = mesh.get("primitives")
    if not isinstance(primitives, list) or len(primitives) != 1 or not isinstance(
            primitives[0], dict):
        raise ValueError("a mesh has not one primitive")
    attributes, extensions = (primitives[0].get(key, {}) for key in ("attributes", "extensions"))
    if not isinstance(attributes, dict) or not isinstance(extensions, dict):
        raise ValueError("a primitive is not an object")
    matrix = numbers(node.get("matrix", np.eye(4).ravel().tolist()), 16, "matrix")
    matrix = matrix.reshape(4, 4, order="F")
    local = table.array(attributes.get("POSITION"), "VEC3", [FLOAT])
    if not np.isfinite(local).all():
        raise ValueError("a position is not finite")
    places = local.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    positions = places @ Z_UP.T
    colours = None
    if "COLOR_0" in attributes:
        colours = np.ascontiguousarray(
            table.array(attributes["COLOR_0"], "VEC4", [UBYTE])[:, :3])
        if len(colours) != len(positions):
            raise ValueError("there are more or less colours than points")
    matches = extensions.get(MATCHES)
    if matches is None:
        return positions, colours, None
    if not isinstance(matches, dict) or not isinstance(matches.get("cameraUids"), list):
        raise ValueError("the matches are not an object")
    ranges = table.array(matches.get("pointIndexRanges"), "VEC2", [UINT])
    if len(ranges) != len(positions):
        raise ValueError("there are more or less ranges of matches than points")
    return positions, colours, (matches["cameraUids"], table.array(
        matches.get("cameraIds"), "SCALAR", [UINT])[:, 0], ranges)


def _observations(match: tuple[list[Any], NDArray[Any], NDArray[Any]], cameras: Sequence[int]
                  ) -> NDArray[np.int64]:
    """int64[M, 2], rows (point, photo)."""
    uids, indices, ranges = match
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
