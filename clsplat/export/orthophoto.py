"""The tiles of a map: colours, heights and what is known, as seen from straight above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, zoom

from clsplat.camera import Camera
from clsplat.export.map_grid import TILE, MapGrid
from clsplat.rendering.slabs import ModelRenderer
from clsplat.scene import Scene

HOLE = 0.5  # of the light passes: the map has a hole there
LEAST_VIEWS = 2  # photos that must show a place: one alone knows no height
STEP = 16  # pixels between the places that are looked for in the photos
SPECK = 3  # pixels: a median over so many squared removes single wrong heights
FINENESS = 64  # heights are multiples of less than this part of a pixel, so that they compress well


@dataclass(frozen=True, eq=False)
class MapTile:
    """A tile of a map.

    Attributes
    ----------
    colours : uint8[TILE, TILE, 4]: red, green, blue and alpha. Alpha is 255, and 0 in holes and
        where fewer than two photos show the place. Colours contain the background that shows
        through, as in the training, which has made dark ground of it: divided by the share that the
        gaussians cover, they would be too bright (by 5 dB on caliterra).
    heights : float32[TILE, TILE], map coordinates; nan where alpha is 0.
    """

    colours: NDArray[np.uint8]
    heights: NDArray[np.float32]


class MapPainter:
    """Draws the tiles of a map.

    Parameters
    ----------
    renderer, rows, degree : the model on the device, for orthographic cameras and median depths, on
        the background of the training; see `rendering.slabs.open_model`.
    offset : float64[3], original coordinates of the origin of the model.
    grid : of the map.
    scene : its cameras tell which places the photos show.
    """

    def __init__(self, renderer: ModelRenderer, rows: Any, degree: int,
                 offset: NDArray[np.float64], grid: MapGrid, scene: Scene) -> None:
        self._renderer, self._rows, self._degree = renderer, rows, degree
        self._offset, self._grid, self._scene = offset, grid, scene
        self._cameras = [view.camera for view in scene.views]
        self._step = 2.0 ** np.floor(np.log2(grid.resolution / FINENESS))

    def tile(self, column: int, row: int) -> MapTile:
        """Draw a tile; column and row as for `MapGrid.camera`."""
        camera = self._grid.camera(column, row)
        frame = self._renderer.render(self._rows, self._renderer.pack(camera.shifted(self._offset)),
                                      TILE, TILE, self._degree, with_depth=True)
        covered = 1 - frame.blended.transmittance.download()
        depths = median_filter(frame.blended.depth.download(), SPECK, mode="nearest")
        heights = np.round((self._grid.ceiling - depths) / self._step) * self._step
        known = (covered >= 1 - HOLE) & self._shown(camera, heights, covered)
        pixels = np.concatenate([frame.image.download(), known[None]]).transpose(1, 2, 0)
        eight_bits = np.where(known[..., None], np.clip(pixels, 0, 1) * 255 + 0.5, 0)
        return MapTile(eight_bits.astype(np.uint8),
                       np.where(known, heights, np.nan).astype(np.float32))

    def _shown(self, camera: Camera, heights: NDArray[np.floating],
               covered: NDArray[np.floating]) -> NDArray[np.bool_]:
        """bool[TILE, TILE]: at least LEAST_VIEWS photos show the place, hidden there or not;
        interpolated between one place in each square of STEP pixels."""
        middles = np.arange(STEP // 2, TILE, STEP)
        rows, columns = (each.ravel() for each in np.meshgrid(middles, middles, indexing="ij"))
        tops, holes = heights[rows, columns], covered[rows, columns] < 1 - HOLE
        if not holes.all():  # which have no height of their own
            tops = np.where(holes, np.median(tops[~holes]), tops)
        across, down = columns + 0.5 - TILE / 2, rows + 0.5 - TILE / 2
        in_camera = np.column_stack([across * self._grid.resolution, down * self._grid.resolution,
                                     self._grid.ceiling - tops])
        places = (in_camera - camera.translation) @ camera.rotation
        seen = shown_by(self._cameras, (places - self._scene.offset) / self._scene.unit)
        square = median_filter((seen >= LEAST_VIEWS).reshape(len(middles), -1), SPECK)
        inside: NDArray[np.bool_] = zoom(square.astype(np.float32), STEP, order=1, mode="nearest",
                                         grid_mode=True) > 0.5
        return inside


def shown_by(cameras: Sequence[Camera], points: NDArray[np.float64]) -> NDArray[np.int64]:
    """int64[N]: how many cameras have points [N, 3], in their world, within their image."""
    total = np.zeros(len(points), np.int64)
    for camera in cameras:
        pixels, depths = camera.project(points)
        total += ((depths > 0) & (pixels > 0).all(axis=1)
                  & (pixels < (camera.width, camera.height)).all(axis=1))
    return total
