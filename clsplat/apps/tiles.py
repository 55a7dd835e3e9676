"""3D Tiles 1.1: a model as a tree of glTF tiles, coarse to fine, for Cesium and other globes.

The finest tiles are the leaves of a balanced octree, and together hold every gaussian once. A tile
above them replaces its children where these would be too small to see: with the gaussians of one of
SIG's levels, if the run kept its models, otherwise with the merged gaussians of its children.

Tiles stand upright, z up; the transform of the root leads from there to the earth (ECEF), or to the
scene where it has no georeference. Content of glTF has y up, and a viewer turns it back.

The content is compressed as SPZ, which CesiumJS needs to draw splats, or plain.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.edit.decimate import decimated
from clsplat.edit.select import merged, selected
from clsplat.edit.transform import half_axes, transformed
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.atomic import replacing
from clsplat.io.folders import new_folder
from clsplat.io.georeference.crs import conversion
from clsplat.io.models.gltf import COMPRESSION, EXTENSION, write_glb, write_spz_glb
from clsplat.io.models.ply import read_ply
from clsplat.io.models.values import Notes, mode_comment, opacities

TILE_GAUSSIANS = 20_000  # of a tile at most: 5 MB with harmonics of degree 3
LEAST_SHARE = 0.25  # of TILE_GAUSSIANS that one of SIG's levels must have in a tile to be used
TAIL_SHARE = 0.01  # of a cell's gaussians at each end of each axis that do not make it long
REACH = 3.0  # standard deviations of a gaussian that count for the box around it
# a viewer refines a tile where its geometric error covers 16 pixels (Cesium's default); a level is
# enough while its mean sigma covers 2 pixels (city/lod.py)
ERROR_OF_SIGMA = 16 / 2
TILESET, CONTENT = "tileset.json", "tiles"
Z_UP = np.array([0.0, 0.0, 1.0])
ECEF = "EPSG:4978"
BASELINE = 100.0  # metres, along which the axes of a CRS are measured on the earth
# `write_glb` turns (x, y, z) by half a turn about z, then z to y; a viewer turns only y to z. For
# `write_spz_glb` the second is all
TURNS = {False: np.diag([-1.0, -1.0, 1.0]), True: np.eye(3)}  # by whether content is compressed


@dataclass(frozen=True, eq=False)
class Cell:
    """A part of space, from `low` to below `high`, float64[3], and the rows of the model in it."""

    rows: NDArray[np.intp]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


@dataclass(eq=False)
class Tile:
    """A node of the tree.

    Attributes
    ----------
    name : its path from the root, a digit a level.
    gaussians : its content, upright.
    low, high : float64[3], the box around its content and that of its children.
    error : its geometric error, world units; 0 for a leaf.
    """

    name: str
    gaussians: Gaussians
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    error: float = 0.0
    children: list[Tile] = field(default_factory=list)

    def all(self) -> Iterator[Tile]:
        """The tile and all below it."""
        yield self
        for child in self.children:
            yield from child.all()


def upright(gaussians: Gaussians, up: NDArray[np.float64]) -> Gaussians:
    """A model after the smallest rotation that turns its `up`, a unit vector, to z."""
    if np.allclose(up, Z_UP, atol=1e-9):
        return gaussians.without_spheres()
    turn, _ = Rotation.align_vectors([Z_UP], [up])
    return transformed(gaussians, rotation=turn.as_matrix())


def tile_tree(gaussians: Gaussians, levels: Sequence[Gaussians] = (),
              limit: int = TILE_GAUSSIANS) -> Tile:
    """Cut a model into a tree of tiles.

    Parameters
    ----------
    gaussians : the model, upright, at least one.
    levels : coarser models of the same scene in the same frame, fine to coarse.
    limit : gaussians of a tile at most.
    """
    positions = gaussians.positions.astype(np.float64)
    coarse = [(level, level.positions.astype(np.float64)) for level in levels]

    def build(name: str, cell: Cell) -> Tile:
        if len(cell.rows) <= limit:
            content = selected(gaussians, cell.rows)
            return Tile(name, content, *_box(content))
        children = [build(f"{name}{number}", part)
                    for number, part in enumerate(_parted(cell, positions, limit))]
        content = _level_in(coarse, cell, limit) or decimated(
            merged([child.gaussians for child in children]), limit)
        boxes = [_box(content), *((child.low, child.high) for child in children)]
        error = max(ERROR_OF_SIGMA * _mean_sigma(content),
                    *(child.error for child in children))
        return Tile(name, content, np.min([box[0] for box in boxes], axis=0),
                    np.max([box[1] for box in boxes], axis=0), error, children)

    return build("0", Cell(np.arange(gaussians.count), np.full(3, -np.inf), np.full(3, np.inf)))


def write_run_tiles(folder: Path, run: Run, gaussians: Gaussians, compressed: bool = True,
                    progress: Callable[[int, int], object] | None = None) -> Tile:
    """Write the model of a run as 3D Tiles, with SIG's levels where the run kept them.

    Parameters
    ----------
    folder : a new or empty folder, which appears as a whole.
    run : tells the levels, what is up, and the georeference.
    gaussians : its finished model or a part of it.
    compressed, progress : see `write_tiles`.

    Raises
    ------
    InputError : the folder is not empty, or pyproj is missing for a georeferenced run.
    """
    with new_folder(folder) as partial:
        up = run.up
        model = upright(gaussians, up)
        placement(model.offset, run.georeference)  # that pyproj is missing is told before the work
        levels = [upright(read_ply(path, gaussians.offset).with_sh_degree(model.sh_degree), up)
                  for _, path in reversed(run.folder.snapshots())]
        tree = tile_tree(model, levels)
        write_tiles(partial, tree, run.georeference, compressed, progress,
                    (mode_comment(run.options.antialiased),))
    return tree


def write_tiles(folder: Path, tree: Tile, georeference: Georeference | None = None,
                compressed: bool = True, progress: Callable[[int, int], object] | None = None,
                comments: Sequence[str] = ()) -> None:
    """Write a tree as tileset.json and a glTF file for each tile.

    Parameters
    ----------
    folder : an existing folder.
    tree : from `tile_tree`; its contents have one offset.
    georeference : of its original coordinates; None: the tileset has those of the scene.
    compressed : whether the content is SPZ, with a tenth of the bytes and 8 to 24 bits a number.
    progress : called with the number of tiles that are written, and of all.
    comments : lines of text for the files of the tiles.
    """
    (folder / CONTENT).mkdir()
    tiles = list(tree.all())
    for number, tile in enumerate(tiles, 1):
        if compressed:
            write_spz_glb(folder / _uri(tile), tile.gaussians, comments)
        else:
            write_glb(folder / _uri(tile), tile.gaussians.located(np.zeros(3)),
                      Notes(tuple(comments), Z_UP))
        if progress:
            progress(number, len(tiles))
    transform, used = placement(tree.gaussians.offset, georeference), [EXTENSION]
    transform[:3, :3] = transform[:3, :3] @ TURNS[compressed]
    if compressed:
        used.append(COMPRESSION)
    tileset = {
        "asset": {"version": "1.1", "generator": "clsplat"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        # Cesium decides by this how to load the content
        "extensions": {"3DTILES_content_gltf": {"extensionsUsed": used,
                                                "extensionsRequired": used}},
        "geometricError": float(np.linalg.norm(tree.high - tree.low)),
        "root": {"transform": transform.T.ravel().tolist(), "refine": "REPLACE",
                 **_record(tree, TURNS[compressed])}}
    with replacing(folder / TILESET) as file:
        file.write(json.dumps(tileset, indent=1, allow_nan=False).encode())


def placement(offset: NDArray[np.float64], georeference: Georeference | None
              ) -> NDArray[np.float64]:
    """[4, 4]: from the coordinates of upright gaussians to those of the earth or the scene.

    The axes of a projected CRS are not quite east and north, nor its unit quite a metre, so they
    are measured on the earth, around the offset.

    Parameters
    ----------
    offset : [3], original coordinates of the tiles' origin.
    georeference : of the original coordinates; None: into those.
    """
    matrix = np.eye(4)
    if georeference is None:
        matrix[:3, 3] = offset
    else:
        to_earth = conversion(georeference.crs, ECEF, "3D Tiles of a georeferenced model")
        place = georeference.to_map(offset)
        ends = place + BASELINE * np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
        found = to_earth(ends)
        matrix[:3, :3] = (found[:3] - found[3:6]).T / (2 * BASELINE)
        matrix[:3, 3] = found[6]
    return matrix


def _uri(tile: Tile) -> str:
    return f"{CONTENT}/{tile.name}.glb"


def _record(tile: Tile, turn: NDArray[np.float64]) -> dict[str, Any]:
    """A tile and those below it as JSON, in coordinates turned by a diagonal matrix [3, 3]."""
    centre = turn @ (tile.low + tile.high) / 2
    half = np.diag((tile.high - tile.low) / 2)
    record: dict[str, Any] = {
        "boundingVolume": {"box": [*centre.tolist(), *half.ravel().tolist()]},
        "geometricError": tile.error, "content": {"uri": _uri(tile)}}
    if tile.children:
        record["children"] = [_record(child, turn) for child in tile.children]
    return record


def _box(gaussians: Gaussians) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners [3] of the box around gaussians, to REACH times their standard deviations."""
    reach = REACH * np.linalg.norm(half_axes(gaussians), axis=2)
    positions = gaussians.positions.astype(np.float64)
    return (positions - reach).min(axis=0), (positions + reach).max(axis=0)


def _parted(cell: Cell, positions: NDArray[np.float64], limit: int) -> list[Cell]:
    """A cell in two to eight parts, halved three times where it has more than `limit` gaussians.

    Halves have equal numbers of gaussians, so that far outliers do not make tiles of their own.
    """
    parts = [cell]
    for _ in range(3):
        parts = [half for part in parts for half in (
            _halves(part, positions) if len(part.rows) > limit else [part])]
    return parts


def _halves(cell: Cell, positions: NDArray[np.float64]) -> list[Cell]:
    """Two cells, on both sides of a plane across the longest side of most gaussians of a cell."""
    within = positions[cell.rows]
    ends = np.quantile(within, (TAIL_SHARE, 1 - TAIL_SHARE), axis=0)
    axis = int(np.argmax(ends[1] - ends[0]))
    half = len(within) // 2
    order = np.argpartition(within[:, axis], half)
    plane = within[order[half], axis]
    below, above = cell.high.copy(), cell.low.copy()
    below[axis] = above[axis] = plane
    return [Cell(np.sort(cell.rows[order[:half]]), cell.low, below),
            Cell(np.sort(cell.rows[order[half:]]), above, cell.high)]


def _level_in(levels: Sequence[tuple[Gaussians, NDArray[np.float64]]], cell: Cell, limit: int
              ) -> Gaussians | None:
    """The gaussians of the finest level in a cell that a tile has room for, if they suffice."""
    for gaussians, positions in levels:
        inside = np.flatnonzero(((positions >= cell.low) & (positions < cell.high)).all(axis=1))
        if len(inside) <= limit:
            return selected(gaussians, inside) if len(inside) >= LEAST_SHARE * limit else None
    return None


def _mean_sigma(gaussians: Gaussians) -> float:
    """Mean standard deviation weighted by opacity, world units."""
    opacity = opacities(gaussians)
    sigma = np.exp(gaussians.log_scales.astype(np.float64)).mean(axis=1)
    return float(opacity @ sigma / max(opacity.sum(), np.finfo(float).tiny))
