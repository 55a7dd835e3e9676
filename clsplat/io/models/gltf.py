"""Gaussians as binary glTF with the extension KHR_gaussian_splatting, in float32 attributes.

Scales are standard deviations, opacities 0 to 1, quaternions x, y, z, w, and harmonics as in a PLY.
The data has glTF's axes, left, up, forward: those of a PLY, which are right, down, forward, after
half a turn about z. A node adds the origin of the positions, and another one above it turns all so
that what is up becomes y.

For 3D Tiles the buffer is a SPZ file (KHR_gaussian_splatting_compression_spz_2). CesiumJS draws no
other splats, and uses its positions as they are stored, with the `matrix` of the first node and no
other transform.
"""

import json
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.fields import reading
from clsplat.io.models import values as stored
from clsplat.io.models.spz import packed_spz, unpacked_spz
from clsplat.io.models.values import Notes, half_turn, log_scales_of, logits, unit
from clsplat.io.records import object_of
from clsplat.io.regular import check_expansion, read_regular

EXTENSION = "KHR_gaussian_splatting"
COMPRESSION = "KHR_gaussian_splatting_compression_spz_2"
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
MAGIC, VERSION, JSON, BINARY = b"glTF", 2, b"JSON", b"BIN\0"
FLOAT, UNSIGNED_BYTE, ARRAY_BUFFER, POINTS = 5126, 5121, 34962, 0
COMPONENTS = {5120: "<i1", UNSIGNED_BYTE: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # by the width
# the attributes but for harmonics: name, field, columns, and what makes one from the field and back
ATTRIBUTES: tuple[tuple[str, str, int, Callable[..., Any], Callable[..., Any]], ...] = (
    ("POSITION", "positions", 3, np.asarray, np.asarray),
    (
        f"{EXTENSION}:ROTATION",
        "quaternions",
        4,
        lambda wxyz: np.roll(unit(wxyz), -1, axis=1),
        lambda xyzw: np.roll(xyzw, 1, axis=1),
    ),
    (f"{EXTENSION}:SCALE", "log_scales", 3, stored.scales_of, log_scales_of),
    (
        f"{EXTENSION}:OPACITY",
        "opacity_logits",
        1,
        lambda values: scipy.special.expit(values),
        lambda column: logits(column[:, 0]),
    ),
    (f"{EXTENSION}:SH_DEGREE_0_COEF_0", "sh_constant", 3, np.asarray, np.asarray),
)
HARMONICS = [
    f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{number}" for degree in (1, 2, 3) for number in range(2 * degree + 1)
]
TURN = np.array([-1.0, -1.0, 1.0])  # half a turn about z
IDENTITY: dict[str, ArrayLike] = {"matrix": np.eye(4).ravel(), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
UPRIGHT = "clsplat: upright"  # the node whose rotation is for viewers, and not read back
# SPZ has y and z of a model the other way round; of these, z becomes y (columns)
STORED_TO_Y_UP = (1.0, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1)


def write_glb(path: Path, gaussians: Gaussians, notes: Notes) -> None:
    """Write gaussians as binary glTF; see `models.write_model`.

    Notes become `asset.extras.comments`. Programs without the extension show the gaussians as
    coloured points.
    """
    rows, origin = stored.stored_rows(gaussians)
    rows = half_turn(rows, axis=2)
    attributes = {name: encode(rows[field]).astype("<f4") for name, field, _, encode, _ in ATTRIBUTES}
    attributes |= zip(HARMONICS, rows["sh_rest"].astype("<f4").transpose(1, 0, 2))
    attributes["COLOR_0"] = stored.OPACITY_STEPS.bytes(
        np.column_stack([stored.colours_of(rows["sh_constant"]), attributes[f"{EXTENSION}:OPACITY"]])
    )
    root: dict[str, Any] = {"name": UPRIGHT, "children": [1]}
    if notes.up is not None:
        turn, _ = scipy.spatial.transform.Rotation.align_vectors([(0.0, 1.0, 0.0)], [notes.up * TURN])
        root["rotation"] = turn.as_quat().tolist()
    place: dict[str, Any] = {"name": "gaussians", "translation": (origin * TURN).tolist()}
    document: dict[str, Any] = {"extensionsUsed": [EXTENSION], "nodes": [root, place]}
    content = b""
    if gaussians.count:  # glTF has no empty accessors
        place["mesh"] = 0
        content = b"".join(values.tobytes() for values in attributes.values())
        sizes = [values.nbytes for values in attributes.values()]
        document |= _mesh(attributes, sortingMethod="cameraDistance", projection="perspective")
        document["bufferViews"] = [
            {"buffer": 0, "byteOffset": end - size, "byteLength": size, "target": ARRAY_BUFFER}
            for size, end in zip(sizes, np.cumsum(sizes).tolist())
        ]
        for view, accessor in enumerate(document["accessors"]):
            accessor["bufferView"] = view
    write_document(path, document, notes.lines, content)


def write_spz_glb(path: Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> None:
    """Write one or more gaussians that stand upright, z up, for 3D Tiles, without their offset;
    InputError if the file cannot be written, or SPZ cannot hold a position."""
    local = gaussians.located(np.zeros(3))
    content, degree = packed_spz(path, local, Notes(tuple(comments)))
    three, four = (np.broadcast_to(np.float32(0), (gaussians.count, width)) for width in (3, 4))
    inside: dict[str, NDArray[Any]] = {  # the buffer, from which a viewer unpacks them
        "POSITION": local.positions * np.array((1, -1, -1), np.float32),
        "COLOR_0": four.astype(np.uint8),
        f"{EXTENSION}:SCALE": three,
        f"{EXTENSION}:ROTATION": four,
        **dict.fromkeys(HARMONICS[: (degree + 1) ** 2 - 1], three),
    }
    both = [EXTENSION, COMPRESSION]
    write_document(
        path,
        {
            "extensionsUsed": both,
            "extensionsRequired": both,
            "nodes": [{"name": UPRIGHT, "mesh": 0, "matrix": STORED_TO_Y_UP}],
            "bufferViews": [{"buffer": 0, "byteLength": len(content)}],
            **_mesh(inside, extensions={COMPRESSION: {"bufferView": 0}}),
        },
        comments,
        content,
    )


def _mesh(attributes: dict[str, NDArray[Any]], **details: Any) -> dict[str, Any]:
    """The members of a document with a mesh of gaussians, and an accessor for each attribute."""
    accessors: list[dict[str, Any]] = []
    for name, values in attributes.items():
        accessors.append({"count": len(values), "componentType": FLOAT, "type": TYPES[math.prod(values.shape[1:])]})
        if values.dtype == np.uint8:
            accessors[-1] |= {"componentType": UNSIGNED_BYTE, "normalized": True}
        if name == "POSITION":
            accessors[-1] |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
    return {
        "accessors": accessors,
        "meshes": [
            {
                "primitives": [
                    {
                        "mode": POINTS,
                        "attributes": {name: at for at, name in enumerate(attributes)},
                        "extensions": {
                            EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", **details}
                        },
                    }
                ]
            }
        ],
    }


def write_document(path: Path, document: dict[str, Any], comments: Iterable[str], content: bytes) -> None:
    """Write a document with one scene, of node 0, with comments, and its one buffer, if it is not
    empty; InputError if the file cannot be written."""
    document = {
        "asset": {"version": "2.0", "generator": "clsplat", "extras": {"comments": list(comments)}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        **document,
    }
    if content:
        document["buffers"] = [{"byteLength": len(content)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = [(text + b" " * (-len(text) % 4), JSON)]
    if content:
        chunks.append((content + b"\0" * (-len(content) % 4), BINARY))
    with replacing(path) as file:
        file.write(HEADER.pack(MAGIC, VERSION, HEADER.size + sum(CHUNK.size + len(data) for data, _ in chunks)))
        for data, kind in chunks:
            file.write(CHUNK.pack(len(data), kind))
            file.write(data)


def read_glb(path: Path, offset: NDArray[np.float64] | None = None) -> tuple[Gaussians, Notes]:
    """Read a binary glTF with KHR_gaussian_splatting, one mesh; see `models.read_with_notes`."""
    with reading(path, f"a binary glTF with {EXTENSION}"):
        document, content = _chunks(read_regular(path))
        found = list(_primitives(document))
        if len(found) > 1 or len(document.get("buffers", ())) > 1:
            raise ValueError("it has several meshes of gaussians or buffers: join them before")
        if found:
            ((primitive, origin),) = found
            rows = _rows(document, content, primitive)
        else:
            rows = {each.name: np.zeros((0, *each.row_shape(0))) for each in LEARNED}
            origin = np.zeros(3)
        match document:
            case {"asset": {"extras": {"comments": [*lines]}}}:
                notes = Notes.of_lines(line for line in lines if isinstance(line, str))
            case _:
                notes = Notes()
        return stored.gaussians_of(path, half_turn(rows, axis=2), origin * TURN, offset), notes


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk of a file."""
    magic, version, _ = HEADER.unpack_from(data)
    if (magic, version) != (MAGIC, VERSION):
        raise ValueError("its header is another")
    chunks, at = {}, HEADER.size
    while at < len(data):
        size, kind = CHUNK.unpack_from(data, at)
        at += CHUNK.size
        if at + size > len(data):
            raise ValueError(f"its {len(data)} bytes are too few for a chunk")
        chunks[kind] = data[at : at + size]
        at += size
    return object_of(chunks[JSON]), chunks.get(BINARY, b"")


def _primitives(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    """The primitives that are gaussians, and the translation float64[3] of each."""
    if EXTENSION not in document.get("extensionsUsed", ()):
        raise ValueError("it has no gaussians")
    for node in document["nodes"]:
        place = np.array(node.get("translation", (0, 0, 0)), np.float64)
        is_plain = all(np.allclose(node.get(name, same), same) for name, same in IDENTITY.items())
        if node.get("name") != UPRIGHT and not (is_plain and ("mesh" in node or not place.any())):
            raise ValueError("a node turns, scales or moves others: apply the transforms before")
        if "mesh" in node:
            for primitive in document["meshes"][node["mesh"]]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield primitive, place


def _rows(document: dict[str, Any], content: bytes, primitive: dict[str, Any]) -> dict[str, NDArray[np.float64]]:
    """The fields of `gaussians.LEARNED` of a primitive, in glTF's axes."""
    others = primitive["extensions"][EXTENSION].get("extensions", {})
    if list(others) == [COMPRESSION]:
        view = document["bufferViews"][others[COMPRESSION]["bufferView"]]
        begin = view.get("byteOffset", 0)
        if view["buffer"] != 0:
            raise ValueError("its gaussians are in another file")
        return half_turn(unpacked_spz(content[begin : begin + view["byteLength"]]), axis=2)
    if others:
        raise ValueError(f"its gaussians are compressed with {', '.join(others)}")
    attributes = primitive["attributes"]

    def values(name: str, width: int) -> NDArray[np.float64]:
        """The values [N, width] of an attribute."""
        found = document["accessors"][attributes[name]]
        view = document["bufferViews"][found["bufferView"]]
        kind = np.dtype(COMPONENTS[found["componentType"]])
        count, stride = found["count"], view.get("byteStride", kind.itemsize * width)
        start = view.get("byteOffset", 0) + found.get("byteOffset", 0)
        if "sparse" in found or found["type"] != TYPES[width] or view["buffer"] != 0 or not stride:
            raise ValueError("an attribute is sparse, of another type or in another file")
        check_expansion(len(content), 8 * width * count)
        # numpy compares the place with the size of the content
        raw = np.ndarray((count, width), kind, content, start, (stride, kind.itemsize))
        result = raw.astype(np.float64)
        if found.get("normalized") and kind.kind != "f":
            result = np.maximum(result / np.iinfo(kind).max, -1)
        return result

    rows = {field: decode(values(name, width)) for name, field, width, _, decode in ATTRIBUTES}
    bands = max(count for count in (0, 3, 8, 15) if all(name in attributes for name in HARMONICS[:count]))
    rows["sh_rest"] = np.zeros((len(rows["positions"]), bands, 3))
    for band, name in enumerate(HARMONICS[:bands]):
        rows["sh_rest"][:, band] = values(name, 3)
    if len({len(column) for column in rows.values()}) != 1:
        raise ValueError("its attributes differ in number")
    return rows
