"""3D Tiles 1.1: a model as a tree of glTF tiles, coarse to fine, for Cesium and other globes.

The finest tiles are the leaves of a balanced octree, and together hold every gaussian once. A tile
above them has the merged gaussians of its children, and replaces these if they would be too small
to see.

Tiles stand upright, z up; the transform of the root leads from there to the earth (ECEF), or to the
scene if it has no georeference. Content of glTF has y up, and a viewer turns it back.

The content is compressed as SPZ, which CesiumJS needs to draw splats.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.models import turned_up
from clsplat.edit.decimate import decimated
from clsplat.edit.select import mean_sigma, merged, parted, selected
from clsplat.edit.transform import half_axes
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.ahead import called_ahead
from clsplat.io.folders import new_folder
from clsplat.io.georeference.crs import conversion
from clsplat.io.models.gltf import COMPRESSION, EXTENSION, write_spz_glb
from clsplat.io.models.values import mode_comment
from clsplat.io.records import write_object

TILE_GAUSSIANS = 20_000  # of a tile at most: 5 MB with harmonics of degree 3
ROUNDS = 3  # of halving, after which a tile has eight children
REACH = 3.0  # standard deviations of a gaussian that count for the box around it
# a viewer refines a tile if its geometric error covers 16 pixels (Cesium's default); a level is
# enough while its mean sigma covers 2 pixels
ERROR_OF_SIGMA = 16 / 2
TILESET, CONTENT = "tileset.json", "tiles"
Z_UP = np.array([0.0, 0.0, 1.0])
ECEF = "EPSG:4978"
BASELINE = 100.0  # metres, along which the axes of a CRS are measured on the earth
Corners = tuple[NDArray[np.float64], NDArray[np.float64]]  # the lowest and the highest, [3] each


@dataclass(eq=False)
class _Tile:
    """A tile: its name, which is its path from the root, its rows of the model and the tiles below;
    once it is written its record and the corners of the box around all of them, and the content of
    one above others until the one above that is written."""

    name: str
    rows: NDArray[np.intp]
    below: Sequence[_Tile] = ()
    content: Gaussians | None = None
    low: Any = None
    high: Any = None
    record: Any = None


def write_run_tiles(folder: Path, run: Run, gaussians: Gaussians, progress: Callable[[int, int], object]) -> int:
    """Write the finished model of a run, or some of its gaussians, as 3D Tiles into a new or empty
    folder, which appears as a whole; otherwise as `write_tiles`."""
    with new_folder(folder) as partial:
        return write_tiles(
            partial,
            turned_up(gaussians, run.up, Z_UP),
            run.georeference,
            (mode_comment(run.options.antialiased),),
            progress=progress,
        )


def write_tiles(
    folder: Path,
    gaussians: Gaussians,
    georeference: Georeference | None = None,
    comments: Sequence[str] = (),
    limit: int = TILE_GAUSSIANS,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> int:
    """Write tileset.json and a glTF file for each tile into an existing folder.

    Parameters
    ----------
    gaussians : the model, upright and not empty.
    georeference : of its original coordinates; None: the tileset has those of the scene.
    comments : lines of text for the files of the tiles.
    limit : gaussians of a tile at most.
    progress : called with the number of tiles that are written, and of all.

    Returns
    -------
    How many tiles there are.
    """
    (folder / CONTENT).mkdir()
    positions = gaussians.positions.astype(np.float64)
    levels, threads = [[_Tile("0", np.arange(gaussians.count))]], os.cpu_count() or 1
    while large := [tile for tile in levels[-1] if len(tile.rows) > limit]:
        parts = called_ahead(lambda tile: parted(positions, tile.rows, limit, ROUNDS), zip(large), threads, threads)
        for tile, some in zip(large, parts):
            tile.below = [_Tile(f"{tile.name}{number}", part) for number, part in enumerate(some)]
        levels.append([child for tile in large for child in tile.below])

    def write(tile: _Tile) -> None:
        """Write a tile, those below which are written."""
        content = (
            selected(gaussians, tile.rows)
            if not tile.below
            else decimated(merged([child.content or selected(gaussians, child.rows) for child in tile.below]), limit)
        )
        low, high = corners(content)
        for child in tile.below:
            low, high = np.minimum(low, child.low), np.maximum(high, child.high)
            child.content = None
        tile.low, tile.high = low, high
        uri = f"{CONTENT}/{tile.name}.glb"
        write_spz_glb(folder / uri, content, comments)
        box = [*((low + high) / 2).tolist(), *np.diag((high - low) / 2).ravel().tolist()]
        tile.record = {"boundingVolume": {"box": box}, "geometricError": 0.0, "content": {"uri": uri}}
        if tile.below:
            tile.content, children = content, [child.record for child in tile.below]
            tile.record |= {
                "children": children,
                "geometricError": max(
                    ERROR_OF_SIGMA * mean_sigma(content), *(child["geometricError"] for child in children)
                ),
            }

    root, count, done = levels[0][0], sum(map(len, levels)), 0
    for level in reversed(levels):
        for _ in called_ahead(write, zip(level), threads, threads):
            done += 1
            progress(done, count)
    used = [EXTENSION, COMPRESSION]
    transform = placement(gaussians.offset, georeference)
    write_object(
        folder / TILESET,
        {
            "asset": {"version": "1.1", "generator": "clsplat"},
            "extensionsUsed": ["3DTILES_content_gltf"],
            # Cesium decides by this how to load the content
            "extensions": {"3DTILES_content_gltf": {"extensionsUsed": used, "extensionsRequired": used}},
            "geometricError": float(np.linalg.norm(root.high - root.low)),
            "root": {"transform": transform.T.ravel().tolist(), "refine": "REPLACE", **root.record},
        },
    )
    return count


def placement(offset: NDArray[np.float64], georeference: Georeference | None) -> NDArray[np.float64]:
    """[4, 4]: from the coordinates of upright gaussians, with this original offset [3], to the
    earth; without a georeference to original coordinates.

    The axes of a projected CRS are not quite east and north, nor its unit quite a metre, so they
    are measured on the earth, around the offset.
    """
    matrix = np.eye(4)
    if georeference is None:
        matrix[:3, 3] = offset
    else:
        to_earth = conversion(georeference.crs, ECEF, "3D Tiles of a georeferenced model")
        found = to_earth(
            georeference.to_map(offset) + BASELINE * np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
        )
        matrix[:3, :3] = (found[:3] - found[3:6]).T / (2 * BASELINE)
        matrix[:3, 3] = found[6]
    return matrix


def corners(gaussians: Gaussians) -> Corners:
    """The corners [3] of the box around gaussians, to REACH times their standard deviations."""
    reach = REACH * np.linalg.norm(half_axes(gaussians), axis=2)
    positions = gaussians.positions.astype(np.float64)
    return (positions - reach).min(axis=0), (positions + reach).max(axis=0)
