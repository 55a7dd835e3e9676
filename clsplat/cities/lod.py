"""Levels of detail: cells far away are drawn from the coarse models of SIG's levels.

At distance d a camera takes f / d samples a world unit (f: focal length, pixels). The detail of a
model is limited by its scene frequency, one over the mean sigma of its gaussians
(training/frequency.py; Xue et al. 2026, whose levels are compared with f / d here). So a level is
enough for a cell while its mean sigma covers at most a fixed number of pixels there; nearer, a
finer level shows more. A finer level than needed is worse, not better: gaussians smaller than a
pixel are drawn as if they covered one.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from clsplat.camera import Camera
from clsplat.cities.merge import READ_TOGETHER, cropped, joined
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import render_view
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.scene import Scene

# pixels that the mean sigma of a level may cover, by whether the renderer is antialiased (measured:
# up to there it fits photos of that size better than the finest level, or at most 0.2 dB worse)
MOST_SIGMA_PIXELS = {False: 2.0, True: 1.1}
CELL_GAUSSIANS = 2048  # of the finest level, at most
TAIL_SHARE = 0.01  # of a cell's gaussians at each end of each axis that its box leaves out


@dataclass(frozen=True, eq=False)
class Levels:
    """A model in cells, each at several levels of detail.

    Attributes
    ----------
    rows : field -> float32[N, ...], of all cells, each coarse to fine.
    sh_degree : of all levels.
    firsts : int[C, L + 1], where the rows of cell and level begin.
    low, high : float64[C, 3], the box around a cell's gaussians, world units.
    frequencies : float64[L], in 1 / world unit.
    """

    rows: dict[str, NDArray[np.float32]]
    sh_degree: int
    firsts: np.ndarray
    low: np.ndarray
    high: np.ndarray
    frequencies: np.ndarray

    @classmethod
    def of(cls, models: list[Gaussians],
           owner: Callable[[NDArray[np.float64]], NDArray[np.integer]] | None = None,
           limit: int = CELL_GAUSSIANS) -> Levels:
        """Cut models into cells.

        Parameters
        ----------
        models : coarse to fine, in one frame.
        owner : positions float64[N, 3] -> int[N], the block of each, whose cells are its own.
        limit : gaussians of the finest model in a cell.
        """
        degree = max(model.sh_degree for model in models)
        models = [model.with_sh_degree(degree) for model in models]
        positions = [model.positions.astype(np.float64) for model in models]
        blocks = [np.zeros(len(p), int) if owner is None else owner(p) for p in positions]
        cells = [cell for block in np.unique(np.concatenate(blocks))
                 for cell in _bisected(positions, [np.flatnonzero(b == block) for b in blocks],
                                       limit)]
        counts = np.array([[len(rows) for rows in cell] for cell in cells])
        ends = np.cumsum(counts).reshape(counts.shape)
        rows = {field.name: np.concatenate([
            model.rows[field.name][rows] for cell in cells for model, rows in zip(models, cell)])
            for field in LEARNED}
        firsts = np.column_stack([ends[:, 0] - counts[:, 0], ends])
        low, high = np.transpose([_box(rows["positions"][first:end])
                                  for first, end in firsts[:, [0, -1]]], (1, 0, 2))
        frequencies = np.array([frequency(model.log_scales, model.opacity_logits)
                                for model in models])
        return cls(rows, degree, firsts, low, high, frequencies)

    def choose(self, camera: Camera, pixels: float) -> NDArray[np.integer]:
        """The level, int[C], that each cell needs for a camera.

        It is the coarsest whose mean sigma covers at most `pixels` where the cell is nearest to the
        camera, else the finest.
        """
        nearest = np.clip(camera.position, self.low, self.high)
        distance = np.linalg.norm(nearest - camera.position, axis=1, keepdims=True)
        enough = max(camera.focal) <= pixels * self.frequencies * distance
        exists = np.diff(self.firsts, axis=1) > 0  # a block may lack a level
        enough &= exists | ~exists[:, -1:]
        enough[:, -1] = True
        level: NDArray[np.integer] = enough.argmax(axis=1)
        return level

    def select(self, choice: NDArray[np.integer]) -> Gaussians:
        """The gaussians of the chosen level, int[C], of each cell."""
        cells = np.arange(len(choice))
        pieces = np.stack([self.firsts[cells, choice], self.firsts[cells, choice + 1]], axis=1)
        return Gaussians({name: np.concatenate([values[first:end] for first, end in pieces])
                          for name, values in self.rows.items()}, self.sh_degree)


def frequency(log_scales: NDArray[np.floating], opacity_logits: NDArray[np.floating]) -> float:
    """The `robust_mean` of training/frequency.py, on the host; 0 without gaussians.

    Parameters
    ----------
    log_scales : float[N, 3].
    opacity_logits : float[N].

    Returns
    -------
    In 1 / world unit.
    """
    opacity = expit(opacity_logits.astype(np.float64))
    sigma = np.exp(log_scales.astype(np.float64)).mean(axis=1)
    return float(opacity.sum() / max(opacity @ sigma, np.finfo(float).tiny))


Rows = list[NDArray[np.integer]]  # of a cell, an array for each level


def _bisected(positions: list[NDArray[np.float64]], members: Rows, limit: int) -> Iterator[Rows]:
    """The rows of each cell.

    The finest level's `members` are halved across their longest side until no cell has more than
    `limit`.
    """
    finest = positions[-1][members[-1]]
    if len(finest) > limit:
        low, high = _box(finest)
        axis = np.argmax(high - low)
        middle = np.median(finest[:, axis])
        below = [p[rows, axis] < middle for p, rows in zip(positions, members)]
        if below[-1].any():  # else half of them are at one place
            for side in (below, [~b for b in below]):
                yield from _bisected(positions, [r[b] for r, b in zip(members, side)], limit)
            return
    yield members


def _box(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """The corners [2, 3] of the box around points [N, 3], without the outermost ones."""
    return np.quantile(points.astype(np.float64), (TAIL_SHARE, 1 - TAIL_SHARE), axis=0)


class Detail:
    """Draws the finished model of a run at levels of detail.

    Parameters
    ----------
    run : a run that was trained with snapshots, or a city.
    scene : reduced to the size of the pictures; the levels are read into its frame.
    device : an open device.
    bias : levels are as coarse as if everything were this many times as far away.

    Attributes
    ----------
    chosen : the gaussians that the last picture was drawn from.
    drawn : how many gaussians were drawn, in all pictures together.

    Raises
    ------
    InputError : the run does not have levels of detail.
    """

    def __init__(self, run: Run, scene: Scene, device: Device, bias: float = 1.0) -> None:
        folder, snapshots = run.folder, run.folder.snapshots()
        if not snapshots or not folder.has_model:
            raise InputError(f"{run.path}: has no levels of detail; train it to its end with "
                             "snapshots = true, and more than one of --levels")
        models = [read_ply(path, scene.offset) for _, path in snapshots]
        models.append(folder.load_model(scene.offset))
        city = CityFolder(run.path)
        partition = city.partition() if city.has_partition else None
        self.levels = Levels.of(models, None if partition is None else (
            lambda positions: partition.owner(scene.offset + positions)))
        self.pixels = bias * MOST_SIGMA_PIXELS[run.options.antialiased]
        self._opened = functools.partial(run.opened, device, scene)
        self._choice: NDArray[np.integer] = np.empty(0, int)
        self.drawn = 0

    def draw(self, camera: Camera) -> NDArray[np.floating]:
        """[H, W, 3], 0 to 1: the picture of a camera at the levels that it needs."""
        choice = self.levels.choose(camera, self.pixels)
        if not np.array_equal(choice, self._choice):
            self.chosen, self._choice = self.levels.select(choice), choice
            self._on_device = self._opened(self.chosen)
        self.drawn += self.chosen.count
        return render_view(*self._on_device, camera)


def merge_levels(city: CityFolder, scene: Scene) -> list[float]:
    """Join the levels of a city's blocks, each cropped to its cell, into levels of the city.

    A block may lack some levels; its finer ones are drawn instead.

    Parameters
    ----------
    city : its folder.
    scene : the whole, as `read_scene` returns it.

    Returns
    -------
    The factors of the levels.
    """
    partition = city.partition()
    parts: dict[float, list[tuple[int, Path]]] = {}
    for block in city.blocks():
        for factor, path in RunFolder(block.run).snapshots():
            parts.setdefault(factor, []).append((block.read()["number"], path))
    for factor, blocks in parts.items():
        pieces = called_ahead(lambda number, path: cropped(
            read_ply(path, scene.offset), partition, number, scene.offset),
            blocks, READ_TOGETHER, READ_TOGETHER)
        RunFolder(city.path).save_snapshot(factor, joined(list(pieces)), scene.offset,
                                           (f"level {factor:g}",))
    return sorted(parts, reverse=True)
