"""Gaussians as binary glTF with KHR_gaussian_splatting_compression_spz_2, for 3D Tiles.

The buffer is a SPZ file. CesiumJS draws no other splats, and uses its positions as they are stored,
with the `matrix` of the first node and no other transform. `gltf.read_glb` reads such files.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.gaussians import Gaussians
from clsplat.io.models.gltf import (
    COMPRESSION,
    EXTENSION,
    FLOAT,
    POINTS,
    UNSIGNED_BYTE,
    UPRIGHT,
    coefficients,
    write_document,
)
from clsplat.io.models.spz import packed_spz
from clsplat.io.models.values import Notes

# SPZ has y and z of a model the other way round; of these, z becomes y (columns)
STORED_TO_Y_UP = (1.0, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1)


def write_spz_glb(path: Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> None:
    """Write gaussians that stand upright, z up, as glTF, y up; the file is replaced as a whole.

    Parameters
    ----------
    path : the file, .glb.
    gaussians : at least one; their offset is left out.
    comments : lines of text.

    Raises
    ------
    InputError : the file cannot be written, or SPZ cannot hold a position.
    """
    local = gaussians.located(np.zeros(3))
    content, degree = packed_spz(path, local, Notes(tuple(comments)))
    stored = local.positions.astype(np.float64) * (1, -1, -1)
    # what is inside the buffer: its type, and normalised bytes where it is a colour
    kinds: dict[str, dict[str, Any]] = {
        "POSITION": {"type": "VEC3", "min": stored.min(axis=0).tolist(),
                     "max": stored.max(axis=0).tolist()},
        "COLOR_0": {"type": "VEC4", "componentType": UNSIGNED_BYTE, "normalized": True},
        f"{EXTENSION}:SCALE": {"type": "VEC3"}, f"{EXTENSION}:ROTATION": {"type": "VEC4"},
        **{name: {"type": "VEC3"} for number in range(1, degree + 1)
           for name in coefficients(number)}}
    both = [EXTENSION, COMPRESSION]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "clsplat",
                  "extras": {"comments": list(comments)}},
        "extensionsUsed": both, "extensionsRequired": both,
        "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"name": UPRIGHT, "mesh": 0, "matrix": STORED_TO_Y_UP}],
        "meshes": [{"primitives": [{
            "mode": POINTS, "attributes": {name: at for at, name in enumerate(kinds)},
            "extensions": {EXTENSION: {
                "kernel": "ellipse", "colorSpace": "srgb_rec709_display",
                "extensions": {COMPRESSION: {"bufferView": 0}}}}}]}],
        "accessors": [{"componentType": FLOAT, "count": gaussians.count, **kind}
                      for kind in kinds.values()],
        "bufferViews": [{"buffer": 0, "byteLength": len(content)}],
        "buffers": [{"byteLength": len(content)}]}
    write_document(path, document, content)
