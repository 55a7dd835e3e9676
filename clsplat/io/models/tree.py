"""A model as a tree of gaussians in one file, of which any node can be read without the others.

The leaves hold every gaussian of the model once. A node above holds fewer, larger ones, which
replace those of its children if these would be too small to see.

The file begins with HEADER. Each node then has its rows, one field of ORDER after the other, as
float32; a node stands behind its children. The index comes last: a line of JSON and the table of
the nodes. All is little endian. The file is written beside its place and renamed when it is whole.
"""

import json
import math
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.fields import reading
from clsplat.io.records import object_of

TREE = "point_cloud.tree"  # in the folder of a run
KIND, CURE = "a tree of gaussians", "write it again with `clsplat merge --tree`"
HEADER = struct.Struct("<16sQQI")  # MAGIC; where the index begins, its bytes and its CRC-32
MAGIC = b"clsplat tree 1\n\0"
# what decides whether a gaussian is drawn comes first
ORDER = ("positions", "log_scales", "quaternions", "opacity_logits", "sh_constant", "sh_rest")
FIELDS = {field.name: field for field in LEARNED}
NO_PARENT = 2**32 - 1
# place: byte of the file; low and high: corners of the box around the centres of its gaussians and
# of those below; usual_low and usual_high: without the outermost ones; sigma: the mean standard
# deviation of its gaussians; largest: the largest one, of those below too
NODE = np.dtype(
    [
        ("place", "<u8"),
        ("count", "<u4"),
        ("parent", "<u4"),
        *((name, "<f8", 3) for name in ("low", "high", "usual_low", "usual_high")),
        ("sigma", "<f8"),
        ("largest", "<f8"),
    ]
)


class TreeWriter:
    """Writes the nodes of a tree, of which `nodes` has the entries; see `writing_tree`."""

    def __init__(self, file: BufferedWriter, sh_degree: int) -> None:
        self._file, self._sh_degree = file, sh_degree
        self.nodes: list[NDArray[Any]] = []

    def add(self, gaussians: Gaussians, facts: Mapping[str, ArrayLike], children: Sequence[int] = ()) -> int:
        """Write a node with the fields of NODE from `low` on, which replaces the nodes with some
        numbers; returns its own."""
        content = gaussians.with_sh_degree(self._sh_degree)
        node = np.zeros((), NODE)
        known = {"place": self._file.tell(), "count": content.count, "parent": NO_PARENT}
        for name, values in {**known, **facts}.items():
            node[name] = values
        for name in ORDER:
            self._file.write(np.ascontiguousarray(content.rows[name], "<f4").data)
        for child in children:
            self.nodes[child]["parent"] = len(self.nodes)
        self.nodes.append(node)
        return len(self.nodes) - 1


@contextmanager
def writing_tree(path: Path, sh_degree: int, offset: ArrayLike) -> Iterator[TreeWriter]:
    """Write a tree, which replaces an existing file as a whole when the block ends, of gaussians
    with the `offset` float64[3]; InputError if it cannot be written."""
    with replacing(path) as file:
        file.write(bytes(HEADER.size))
        writer = TreeWriter(file, sh_degree)
        yield writer
        record = {"sh_degree": sh_degree, "offset": np.asarray(offset, np.float64).tolist(), "nodes": len(writer.nodes)}
        index = json.dumps(record).encode() + b"\n" + np.array(writer.nodes, NODE).tobytes()
        place = file.tell()
        file.write(index)
        file.seek(0)
        file.write(HEADER.pack(MAGIC, place, len(index), zlib.crc32(index)))


class Tree:
    """A tree on disk, whose index is in memory; InputError if there is none, or it is damaged.

    Attributes
    ----------
    sh_degree, offset : of its gaussians.
    nodes : NODE[K]; a node stands behind its children, the root is the last.
    is_leaf : bool[K].
    count : how many gaussians the leaves have.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with reading(path, KIND, CURE):
            # it stays open: a tree that replaces this one does not change what is read
            self._file = open(path, "rb")  # noqa: SIM115
            magic, place, length, crc = HEADER.unpack(self._file.read(HEADER.size))
            if magic != MAGIC or place + length != os.fstat(self._file.fileno()).st_size:
                raise ValueError("its header is that of another format or size")
            self._file.seek(place)
            index = self._file.read(length)
            if zlib.crc32(index) != crc:
                raise ValueError("its index has another checksum")
            line, _, table = index.partition(b"\n")
            record, self.nodes = object_of(line), np.frombuffer(table, NODE)
            if not len(self.nodes):
                raise ValueError("it has no nodes")
            self.sh_degree = int(record["sh_degree"])
            self.offset = np.array(record["offset"], np.float64).reshape(3)
        self.is_leaf = ~np.isin(np.arange(len(self.nodes)), self.nodes["parent"])
        self.count = int(self.nodes["count"][self.is_leaf].sum())

    def read(self, number: int, name: str) -> NDArray[np.float32]:
        """float32[n, *row shape]: the rows of a field of a node."""
        degree, (place, count, *_) = self.sh_degree, self.nodes[number].item()
        before = sum(FIELDS[other].width(degree) for other in ORDER[: ORDER.index(name)])
        shape = (count, *FIELDS[name].row_shape(degree))
        with reading(self.path, KIND, CURE):  # reshape refuses rows that end early
            self._file.seek(place + 4 * before * count)
            return np.fromfile(self._file, "<f4", math.prod(shape)).reshape(shape)
