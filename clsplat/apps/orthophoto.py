"""The tiles of a map: colours, heights and what is known, as seen from straight above; and a coarse
drawing of a scene and its surroundings, made before the map, of where it can show anything."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.apps.map_grid import EXTENT, LARGEST_SIDE, TILE, MapGrid, ground_resolution
from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.evaluation.run import Run
from clsplat.rendering.project import LOW_PASS
from clsplat.rendering.slabs import open_model
from clsplat.scene import Scene

MEDIAN, FIRST = 50, 90  # per cent of the light that still passes, at the depths that are drawn
HOLE = 0.5  # of the light passes: the map has a hole there
LEAST_VIEWS = 2  # photos that must show a place: one alone gives no height
STEP = 16  # pixels between the places that are looked for in the photos
SPECK = 3  # pixels: a median over so many squared removes single wrong heights
FINENESS = 64  # heights are multiples of less than this part of a pixel, so that they compress well
AROUND = 0.5  # of the extent of the sparse points, on each side
LEAST_PART = 0.05  # of the largest part that is known: smaller islands are stray gaussians
BESIDE = 2  # pixels around what is known that are drawn, too


class MapPainter:
    """Draws the tiles of the map of a run; the cameras of the scene show which places the photos
    cover."""

    def __init__(self, device: Device, run: Run, grid: MapGrid, scene: Scene) -> None:
        model, options = run.finished_model, run.options
        # splats were trained with a low-pass of so many pixels of the photos: they keep their size
        finer = max(1.0, ground_resolution(scene) / grid.resolution)
        self._renderer, self._rows = open_model(
            device, model, 0.0, options.antialiased, options.background, orthographic=True, low_pass=LOW_PASS * finer**2
        )
        self._model, self._grid, self._scene = model, grid, scene
        self._cameras = [view.camera for view in scene.views]
        self._step = 2.0 ** np.floor(np.log2(grid.resolution / FINENESS))

    def tile(self, column: int, row: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Draw a tile; column and row as for `MapGrid.camera`.

        Returns
        -------
        Colours uint8[TILE, TILE, 4]: red, green, blue and alpha, which is 255, and 0 in holes and
        where fewer than two photos show the place. Colours contain the background that shows
        through, as in the training, which has made dark ground of it: divided by the share that the
        gaussians cover, they would be too bright (by 5 dB on caliterra). Surface
        float32[TILE, TILE, 2], map units: heights, and how far above them the first tenth of the
        light is held back, which shows how sure a height is; nan where alpha is 0, and below the
        floor of the map.
        """
        camera = self._grid.camera(column, row)
        packed = self._renderer.pack(camera.shifted(self._model.offset))
        frame, first = (
            self._renderer.render(
                self._rows, packed, TILE, TILE, self._model.sh_degree, with_depth=True, depth_percent=percent
            )
            for percent in (MEDIAN, FIRST)
        )
        covered = 1 - frame.blended.transmittance.download()
        heights, highest = (
            np.round(
                (self._grid.ceiling - scipy.ndimage.median_filter(each.blended.depth.download(), SPECK, mode="nearest"))
                / self._step
            )
            * self._step
            for each in (frame, first)
        )
        known = (covered >= 1 - HOLE) & self._shown(camera, heights, covered)
        pixels = np.concatenate([frame.image.download(), known[None]]).transpose(1, 2, 0)
        eight_bits = np.where(known[..., None], np.clip(pixels, 0, 1) * 255 + 0.5, 0)
        surface = np.stack([heights, highest - heights], axis=-1)
        supported = known & (heights >= self._grid.floor)
        return (eight_bits.astype(np.uint8), np.where(supported[..., None], surface, np.nan).astype(np.float32))

    def _shown(self, camera: Camera, heights: NDArray[np.floating], covered: NDArray[np.floating]) -> NDArray[np.bool_]:
        """bool[TILE, TILE]: at least LEAST_VIEWS photos show the place, hidden there or not;
        interpolated between one place in each square of STEP pixels."""
        middles = np.arange(STEP // 2, TILE, STEP)
        rows, columns = (each.ravel() for each in np.meshgrid(middles, middles, indexing="ij"))
        tops, holes = heights[rows, columns], covered[rows, columns] < 1 - HOLE
        if not holes.all():  # which have no height of their own
            tops = np.where(holes, np.median(tops[~holes]), tops)
        across, down = columns + 0.5 - TILE / 2, rows + 0.5 - TILE / 2
        in_camera = np.column_stack(
            [across * self._grid.resolution, down * self._grid.resolution, self._grid.ceiling - tops]
        )
        places = (in_camera - camera.translation) @ camera.rotation
        seen = shown_by(self._cameras, (places - self._scene.offset) / self._scene.unit)
        square = scipy.ndimage.median_filter((seen >= LEAST_VIEWS).reshape(len(middles), -1), SPECK)
        inside: NDArray[np.bool_] = (
            scipy.ndimage.zoom(square.astype(np.float32), STEP, order=1, mode="nearest", grid_mode=True) > 0.5
        )
        return inside


def shown_by(cameras: Sequence[Camera], points: NDArray[np.float64]) -> NDArray[np.int64]:
    """int64[N]: how many cameras have points [N, 3], in their world, within their image."""
    total = np.zeros(len(points), np.int64)
    for camera in cameras:
        total += camera.shows(points)
    return total


@dataclass(frozen=True, eq=False)
class Extent:
    """Where a map shows anything.

    Attributes
    ----------
    grid : of one tile, around the scene.
    known : bool[TILE, TILE], which of its pixels have a height, lie beside one that does, or are
        enclosed by these; small islands excepted.
    """

    grid: MapGrid
    known: NDArray[np.bool_]

    def inside(self, grid: MapGrid, column: int, row: int) -> NDArray[np.bool_]:
        """bool[TILE, TILE]: which pixels of a tile of a grid lie where anything is known."""
        left, _, _, top = grid.tile_bounds(column, row)
        steps = (np.arange(TILE) + 0.5) * grid.resolution
        places = np.stack([left + steps, top - steps], axis=1)
        columns, rows = self.grid.pixels(places).T - 0.5
        inside: NDArray[np.bool_] = (
            scipy.ndimage.map_coordinates(
                self.known.astype(np.float32), np.meshgrid(rows, columns, indexing="ij"), order=1
            )
            > 0.5
        )
        return inside

    def around(self, grid: MapGrid) -> MapGrid:
        """A grid with the bounds of all that is known."""
        rows, columns = np.nonzero(self.known)
        if not len(rows):
            return grid
        size = self.grid.resolution
        wider = grid.within(
            (
                self.grid.left + columns.min() * size,
                self.grid.top - (rows.max() + 1) * size,
                self.grid.left + (columns.max() + 1) * size,
                self.grid.top - rows.min() * size,
            )
        )
        return grid if max(wider.columns, wider.rows) > LARGEST_SIDE else wider


def extent_of(device: Device, run: Run, scene: Scene, grid: MapGrid) -> Extent:
    """What the map of a run can show; the arguments are those of `map.write_map`."""
    places = grid.to_map(scene.offset + scene.unit * scene.points)
    (left, bottom), (right, top) = np.quantile(places[:, :2], EXTENT, axis=0)
    size = (1 + 2 * AROUND) * max(right - left, top - bottom, TILE * np.spacing(abs(right))) / TILE
    middle = (left + right) / 2, (bottom + top) / 2
    coarse = replace(
        grid,
        left=float(middle[0] - TILE / 2 * size),
        resolution=float(size),
        top=float(middle[1] + TILE / 2 * size),
        columns=TILE,
        rows=TILE,
    )
    _, surface = MapPainter(device, run, coarse, scene).tile(0, 0)
    known = scipy.ndimage.binary_opening(np.isfinite(surface[..., 0]), np.ones((3, 3)))
    parts, count = scipy.ndimage.label(known)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    large = (sizes >= LEAST_PART * sizes.max())[parts] & known
    return Extent(coarse, scipy.ndimage.binary_fill_holes(scipy.ndimage.binary_dilation(large, iterations=BESIDE)))
