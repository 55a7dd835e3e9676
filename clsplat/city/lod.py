"""Levels of detail: cells far away are drawn from the coarse models that SIG's levels left.

At distance d a camera takes f / d samples a world unit (f: focal length, pixels). What a model can
show ends at its scene frequency, one over the mean sigma of its gaussians (frequency.py; Xue et al.
2026, whose levels this ties to f / d). So a level is enough for a cell while the mean sigma covers
at most so many pixels there; beyond, a finer one shows more. A finer level than needed is no better
but worse: gaussians smaller than a pixel are drawn as if they covered one.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import expit

from clsplat.city.merge import cropped, joined, partition_of
from clsplat.errors import InputError
from clsplat.evaluation.metrics import psnr
from clsplat.evaluation.views import photo_of, read_cameras_for, render_view, run_options
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.city import CityFolder
from clsplat.io.folders import make_folder
from clsplat.io.images import write_image
from clsplat.io.ply import read_ply
from clsplat.io.regular import native
from clsplat.io.run import MODEL, RunFolder
from clsplat.rendering.slabs import open_model
from clsplat.training.initialise import of_degree

# pixels that the mean sigma of a level may cover, by whether the renderer is antialiased (measured:
# to there it meets photos as small better, or at most 0.2 dB worse, than the finest level does)
PIXELS = {False: 2.0, True: 1.1}
CELL = 2048  # gaussians of the finest level in a cell, at most
TAIL = 0.01  # share of a cell's gaussians at each end of each axis that do not stretch its box
SUPERSAMPLING = 4  # samples a pixel along each axis, of what pictures without a photo are held to


@dataclass(frozen=True, eq=False)
class Levels:
    """A model in cells, each at several levels of detail.

    rows: field -> float32[N, ...], of all cells, each coarse to fine; firsts: int[C, L + 1], where
    the rows of cell and level begin; low, high: float64[C, 3], the box around a cell's gaussians,
    world units; frequencies: float64[L], in 1 / world unit.
    """

    rows: dict
    sh_degree: int
    firsts: np.ndarray
    low: np.ndarray
    high: np.ndarray
    frequencies: np.ndarray

    @classmethod
    def of(cls, models, owner=None, limit=CELL):
        """Levels from Gaussians, coarse to fine, in one frame.

        owner: positions float64[N, 3] -> int[N], the block of each, whose cells are its own;
        limit: gaussians of the finest model in a cell.
        """
        degree = max(model.sh_degree for model in models)
        models = [of_degree(model, degree) for model in models]
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

    def choose(self, camera, pixels):
        """int[C]: the level that each cell needs for a Camera: the coarsest whose mean sigma covers
        at most so many pixels where the cell is nearest, else the finest."""
        nearest = np.clip(camera.position, self.low, self.high)
        distance = np.linalg.norm(nearest - camera.position, axis=1, keepdims=True)
        enough = max(camera.focal) <= pixels * self.frequencies * distance
        there = np.diff(self.firsts, axis=1) > 0  # a block may lack a level
        enough &= there | ~there[:, -1:]
        enough[:, -1] = True
        return enough.argmax(axis=1)

    def take(self, choice):
        """The Gaussians of the level int[C] of each cell."""
        cells = np.arange(len(choice))
        pieces = np.stack([self.firsts[cells, choice], self.firsts[cells, choice + 1]], axis=1)
        return Gaussians({name: np.concatenate([values[first:end] for first, end in pieces])
                          for name, values in self.rows.items()}, self.sh_degree)


def frequency(log_scales, opacity_logits):
    """The `robust_mean` of frequency.py, in 1 / world unit, on the host; 0 without gaussians.

    log_scales: float[N, 3]; opacity_logits: float[N].
    """
    opacity = expit(opacity_logits.astype(np.float64))
    sigma = np.exp(log_scales.astype(np.float64)).mean(axis=1)
    return opacity.sum() / max(opacity @ sigma, np.finfo(float).tiny)


def _bisected(positions, members, limit):
    """Lists of rows, an int array a level, of each cell: halves of halves of the finest level's
    `members`, across the longest side, until none has more than `limit`."""
    finest = positions[-1][members[-1]]
    if len(finest) > limit:
        low, high = _box(finest)
        axis = np.argmax(high - low)
        middle = np.median(finest[:, axis])
        below = [p[rows, axis] < middle for p, rows in zip(positions, members)]
        if below[-1].any():  # else half of them lie at one place
            for side in (below, [~b for b in below]):
                yield from _bisected(positions, [r[b] for r, b in zip(members, side)], limit)
            return
    yield members


def _box(points):
    """(low, high), float64[3] each, without the outermost of points [N, 3]."""
    return np.quantile(points.astype(np.float64), (TAIL, 1 - TAIL), axis=0)


class Detail:
    """Draws a run's model at levels of detail, and in full.

    run: RunFolder; scene: the Scene, reduced, whose frame to use; options: the run's TrainOptions;
    bias: coarser levels, as if everything were so many times as far away. Raises InputError where
    the run has no levels.
    """

    def __init__(self, run, scene, options, device, bias=1.0):
        snapshots = run.snapshots()
        if not snapshots or not run.has_model:
            raise InputError(f"{run.path}: has no levels of detail; train it to its end with "
                             "--snapshots, and more than one of --levels")
        models = [read_ply(path, scene.offset) for _, path in snapshots]
        models.append(read_ply(run.path / MODEL, scene.offset))
        city = CityFolder(run.path)
        partition = partition_of(city) if city.has_partition else None
        self.levels = Levels.of(models, partition and (
            lambda positions: partition.owner(scene.offset + positions)))
        self.device, self.background = device, options.background
        self.near, self.antialiased = options.near or scene.near_plane, options.antialiased
        self.pixels = bias * PIXELS[self.antialiased]
        self.choice = self.chosen = None
        self.full = self._opened(models[-1])

    def draw(self, camera):
        """(image float32[H, W, 3] in 0..1, gaussians) at the levels that a Camera needs."""
        choice = self.levels.choose(camera, self.pixels)
        if not np.array_equal(choice, self.choice):
            self.choice, self.chosen = choice, self._opened(self.levels.take(choice))
        gaussians, renderer, rows = self.chosen
        return render_view(renderer, rows, gaussians.sh_degree, camera), gaussians.count

    def draw_full(self, camera, samples=1):
        """As `draw`, the finest level alone: the mean of samples x samples a pixel."""
        gaussians, renderer, rows = self.full
        height, width = camera.height, camera.width
        image = render_view(renderer, rows, gaussians.sh_degree,
                            camera.resized(samples * width, samples * height))
        image = image.reshape(height, samples, width, samples, 3).mean(axis=(1, 3))
        return image, gaussians.count

    def _opened(self, gaussians):
        """(gaussians, what draws them, their rows)."""
        return gaussians, *open_model(self.device, gaussians, self.near, self.antialiased,
                                      self.background)


def compare_views(model, scene_path, folder, device, views="all", beside=False, bias=1.0, away=0.0,
                  downscale=1.0):
    """Render a run's views at levels of detail to PNG files; yields a dict for each.

    The first five arguments as in `evaluate.views.render_views`; beside: put the full model's
    render and the reference at the right; bias: see `Detail`; away: `moved_away`'s factor;
    downscale: of pictures and photos, which then have as few pixels a world unit as from afar.
    A dict has name; gaussians, share: drawn, and of the full model; psnr_full, dB, against the full
    model's render; psnr, full_psnr: of both against the reference; seconds, full_seconds: of both,
    without compiling, and at levels of detail with choosing and taking the gaussians. The reference
    is the photo; from away, where there is none, the full model at SUPERSAMPLING^2 samples a pixel.
    """
    run, folder = RunFolder.open(model), Path(folder)
    options = run_options(run)
    scene = read_cameras_for(run, scene_path)
    scene = scene.reduced(options.downscale, options.max_resolution).reduced(downscale)
    train, test = scene.split(options.test_every)
    chosen = {"all": scene.views, "train": train, "test": test}[views]
    if not chosen:
        raise InputError(f"{scene.name}: no {views} views; choose others with --views")
    detail = Detail(run, scene, options, device, bias)
    for view in chosen:
        camera, shown = view.camera, np.s_[:, :]
        if away:
            camera, shown = moved_away(view.camera, scene.points, away)
        image, count, seconds = _timed(device, detail.draw, camera)
        full, total, full_seconds = _timed(device, detail.draw_full, camera)
        reference = detail.draw_full(camera, SUPERSAMPLING)[0] if away else photo_of(view)
        path = folder / native(f"{view.name}.png")
        make_folder(path.parent)
        write_image(path, np.concatenate([image, full, reference], axis=1) if beside else image)
        image, full, reference = image[shown], full[shown], reference[shown]
        yield {"name": view.name, "gaussians": count, "share": count / total,
               "psnr_full": psnr(image, full), "psnr": psnr(image, reference),
               "full_psnr": psnr(full, reference), "seconds": seconds,
               "full_seconds": full_seconds}


def moved_away(camera, points, factor):
    """(camera, part): the Camera moved back along its axis by `factor` times the distance of what
    it sees, and the part of its image, two slices, that shows what it saw: the rest was perhaps
    never photographed.

    points: float64[N, 3]; the median depth of those in the image is the distance. InputError where
    there are none.
    """
    pixel, depth = camera.project(points)
    size, centre = np.array([camera.width, camera.height]), np.array(camera.centre)
    seen = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
    if not seen.any():
        raise InputError("--away: a view sees none of the sparse points, so nothing says how far "
                         "away it is; choose others with --views")
    back = np.array([0, 0, factor * np.median(depth[seen])])
    ends = np.clip(centre + np.array([-centre, size - centre]) / (1 + factor), 0, size)
    left, top, right, bottom = (*np.floor(ends[0]).astype(int), *np.ceil(ends[1]).astype(int))
    return (replace(camera, translation=camera.translation + back),
            np.s_[top:bottom, left:right])


def merge_levels(city, scene):
    """Join the levels of the blocks of a CityFolder, each cropped to its cell, to levels of the
    city; returns their factors. A block may lack some: its finer ones are drawn instead.

    scene: the whole Scene, as `read_scene` gave it.
    """
    partition = partition_of(city)
    parts = {}
    for block in city.blocks():
        for factor, path in RunFolder(block.run).snapshots():
            parts.setdefault(factor, []).append((block.read()["number"], path))
    for factor, blocks in parts.items():
        pieces = [cropped(read_ply(path, scene.offset), partition, number, scene.offset)
                  for number, path in blocks]
        RunFolder(city.path).save_snapshot(factor, joined(pieces), scene.offset,
                                           (f"level {factor:g}",))
    return sorted(parts, reverse=True)


def _timed(device, draw, camera):
    """(image, gaussians) that `draw` returns, and the seconds that it took without compiling."""
    begin = time.perf_counter() - device.build_seconds
    return *draw(camera), time.perf_counter() - device.build_seconds - begin
