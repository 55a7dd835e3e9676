"""3D Tiles 1.1: a model as a tree of glTF tiles, coarse to fine, for Cesium and other globes.

The finest tiles are the leaves of a balanced octree, and together hold every gaussian once. A tile
above them has the merged gaussians of its children, and replaces these if they would be too small
to see.

Tiles stand upright, z up; the transform of the root leads from there to the earth (ECEF), or to the
scene if it has no georeference. Content of glTF has y up, and a viewer turns it back.

The content is compressed as SPZ, which CesiumJS needs to draw splats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.models import turned_up
from clsplat.edit.decimate import decimated
from clsplat.edit.select import halves, merged, selected
from clsplat.edit.transform import half_axes
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.folders import new_folder
from clsplat.io.georeference.crs import conversion
from clsplat.io.models.gltf import COMPRESSION, EXTENSION, write_spz_glb
from clsplat.io.models.values import mode_comment, opacities
from clsplat.io.records import write_object

TILE_GAUSSIANS = 20_000  # of a tile at most: 5 MB with harmonics of degree 3
REACH = 3.0  # standard deviations of a gaussian that count for the box around it
# a viewer refines a tile if its geometric error covers 16 pixels (Cesium's default); a level is
# enough while its mean sigma covers 2 pixels
ERROR_OF_SIGMA = 16 / 2
TILESET, CONTENT = "tileset.json", "tiles"
Z_UP = np.array([0.0, 0.0, 1.0])
ECEF = "EPSG:4978"
BASELINE = 100.0  # metres, along which the axes of a CRS are measured on the earth


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

    @property
    def uri(self) -> str:
        """The place of its content beside tileset.json."""
        return f"{CONTENT}/{self.name}.glb"

    def all(self) -> Iterator[Tile]:
        """The tile and all below it."""
        yield self
        for child in self.children:
            yield from child.all()


def tile_tree(gaussians: Gaussians, limit: int = TILE_GAUSSIANS) -> Tile:
    """Cut a model, which stands upright and is not empty, into a tree of tiles of at most `limit`
    gaussians."""
    positions = gaussians.positions.astype(np.float64)

    def build(name: str, rows: NDArray[np.intp]) -> Tile:
        if len(rows) <= limit:
            content = selected(gaussians, rows)
            return Tile(name, content, *_box(content))
        parts = [rows]
        for _ in range(3):  # into two to eight
            parts = [half for part in parts for half in (
                halves(positions, part) if len(part) > limit else (part,))]
        children = [build(f"{name}{number}", part) for number, part in enumerate(parts)]
        content = decimated(merged([child.gaussians for child in children]), limit)
        low, high = _box(content)
        return Tile(name, content, np.min([low, *(child.low for child in children)], axis=0),
                    np.max([high, *(child.high for child in children)], axis=0),
                    max(ERROR_OF_SIGMA * _mean_sigma(content),
                        *(child.error for child in children)), children)

    return build("0", np.arange(gaussians.count))


def write_run_tiles(folder: Path, run: Run, gaussians: Gaussians,
                    progress: Callable[[int, int], object] | None = None) -> Tile:
    """Write the finished model of a run, or some of its gaussians, as 3D Tiles into a new or empty
    folder, which appears as a whole; `progress` as for `write_tiles`."""
    with new_folder(folder) as partial:
        tree = tile_tree(turned_up(gaussians, run.up, Z_UP))
        write_tiles(partial, tree, run.georeference, progress,
                    (mode_comment(run.options.antialiased),))
    return tree


def write_tiles(folder: Path, tree: Tile, georeference: Georeference | None = None,
                progress: Callable[[int, int], object] | None = None,
                comments: Sequence[str] = ()) -> None:
    """Write a tree as tileset.json and a glTF file for each tile into an existing folder.

    Parameters
    ----------
    tree : from `tile_tree`; its contents have one offset.
    georeference : of its original coordinates; None: the tileset has those of the scene.
    progress : called with the number of tiles that are written, and of all.
    comments : lines of text for the files of the tiles.
    """
    (folder / CONTENT).mkdir()
    tiles = list(tree.all())
    for number, tile in enumerate(tiles, 1):
        write_spz_glb(folder / tile.uri, tile.gaussians, comments)
        if progress:
            progress(number, len(tiles))
    used = [EXTENSION, COMPRESSION]
    transform = placement(tree.gaussians.offset, georeference)
    write_object(folder / TILESET, {
        "asset": {"version": "1.1", "generator": "clsplat"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        # Cesium decides by this how to load the content
        "extensions": {"3DTILES_content_gltf": {"extensionsUsed": used,
                                                "extensionsRequired": used}},
        "geometricError": float(np.linalg.norm(tree.high - tree.low)),
        "root": {"transform": transform.T.ravel().tolist(), "refine": "REPLACE",
                 **_record(tree)}})


def placement(offset: NDArray[np.float64], georeference: Georeference | None
              ) -> NDArray[np.float64]:
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
        found = to_earth(georeference.to_map(offset) + BASELINE * np.concatenate(
            [np.eye(3), -np.eye(3), np.zeros((1, 3))]))
        matrix[:3, :3] = (found[:3] - found[3:6]).T / (2 * BASELINE)
        matrix[:3, 3] = found[6]
    return matrix


def _record(tile: Tile) -> dict[str, Any]:
    """A tile and those below it as JSON."""
    centre, half = (tile.low + tile.high) / 2, np.diag((tile.high - tile.low) / 2)
    record: dict[str, Any] = {
        "boundingVolume": {"box": [*centre.tolist(), *half.ravel().tolist()]},
        "geometricError": tile.error, "content": {"uri": tile.uri}}
    if tile.children:
        record["children"] = [_record(child) for child in tile.children]
    return record


def _box(gaussians: Gaussians) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners [3] of the box around gaussians, to REACH times their standard deviations."""
    reach = REACH * np.linalg.norm(half_axes(gaussians), axis=2)
    positions = gaussians.positions.astype(np.float64)
    return (positions - reach).min(axis=0), (positions + reach).max(axis=0)


def _mean_sigma(gaussians: Gaussians) -> float:
    """Mean standard deviation weighted by opacity, world units."""
    opacity = opacities(gaussians)
    sigma = np.exp(gaussians.log_scales.astype(np.float64)).mean(axis=1)
    return float(opacity @ sigma / max(opacity.sum(), np.finfo(float).tiny))
