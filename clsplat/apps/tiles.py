"""3D Tiles 1.1: a model as a tree of glTF tiles, coarse to fine, for Cesium and other globes.

The finest tiles are the leaves of a balanced octree, and together hold every gaussian once. A tile
above them has the merged gaussians of its children, and replaces these if they would be too small
to see.

Tiles stand upright, z up; the transform of the root leads from there to the earth (ECEF), or to the
scene if it has no georeference. Content of glTF has y up, and a viewer turns it back.

The content is compressed as SPZ, which CesiumJS needs to draw splats.
"""

from collections.abc import Callable, Sequence
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


def write_run_tiles(folder: Path, run: Run, gaussians: Gaussians,
                    progress: Callable[[int, int], object]) -> int:
    """Write the finished model of a run, or some of its gaussians, as 3D Tiles into a new or empty
    folder, which appears as a whole; otherwise as `write_tiles`."""
    with new_folder(folder) as partial:
        return write_tiles(partial, turned_up(gaussians, run.up, Z_UP), run.georeference,
                           (mode_comment(run.options.antialiased),), progress=progress)


def write_tiles(folder: Path, gaussians: Gaussians, georeference: Georeference | None = None,
                comments: Sequence[str] = (), limit: int = TILE_GAUSSIANS,
                progress: Callable[[int, int], object] = lambda *_: None) -> int:
    """Write tileset.json and a glTF file for each tile into an existing folder.

    Parameters
    ----------
    gaussians : the model, upright and not empty.
    georeference : of its original coordinates; None: the tileset has those of the scene.
    comments : lines of text for the files of the tiles.
    limit : gaussians of a tile at most.
    progress : called with the number of gaussians in finished leaves, and of all.

    Returns
    -------
    How many tiles there are.
    """
    (folder / CONTENT).mkdir()
    positions = gaussians.positions.astype(np.float64)
    done = tiles = 0

    def write(name: str, rows: NDArray[np.intp]) -> tuple[Gaussians, Corners, dict[str, Any]]:
        """Write a tile, named by its path from the root, and those below it; returns its content,
        the box around all of them, and its record."""
        nonlocal done, tiles
        below = [] if len(rows) <= limit else [
            write(f"{name}{number}", part)
            for number, part in enumerate(parted(positions, rows, limit, ROUNDS))]
        records = [record for *_, record in below]
        if below:
            content = decimated(merged([child for child, *_ in below]), limit)
            error = max(ERROR_OF_SIGMA * mean_sigma(content),
                        *(record["geometricError"] for record in records))
        else:
            content, error = selected(gaussians, rows), 0.0
            done += len(rows)
        low, high = _corners(content)
        for _, (least, most), _ in below:
            low, high = np.minimum(low, least), np.maximum(high, most)
        uri = f"{CONTENT}/{name}.glb"
        write_spz_glb(folder / uri, content, comments)
        tiles += 1
        progress(done, gaussians.count)
        box = [*((low + high) / 2).tolist(), *np.diag((high - low) / 2).ravel().tolist()]
        return content, (low, high), {
            "boundingVolume": {"box": box}, "geometricError": error, "content": {"uri": uri},
            **({"children": records} if records else {})}

    _, (low, high), root = write("0", np.arange(gaussians.count))
    used = [EXTENSION, COMPRESSION]
    transform = placement(gaussians.offset, georeference)
    write_object(folder / TILESET, {
        "asset": {"version": "1.1", "generator": "clsplat"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        # Cesium decides by this how to load the content
        "extensions": {"3DTILES_content_gltf": {"extensionsUsed": used,
                                                "extensionsRequired": used}},
        "geometricError": float(np.linalg.norm(high - low)),
        "root": {"transform": transform.T.ravel().tolist(), "refine": "REPLACE", **root}})
    return tiles


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


def _corners(gaussians: Gaussians) -> Corners:
    """The corners [3] of the box around gaussians, to REACH times their standard deviations."""
    reach = REACH * np.linalg.norm(half_axes(gaussians), axis=2)
    positions = gaussians.positions.astype(np.float64)
    return (positions - reach).min(axis=0), (positions + reach).max(axis=0)
