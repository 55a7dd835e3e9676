"""How much shows where blocks meet: overlap, density and error along each border.

A border is the face that two cells share; its strip reaches into both by the smaller of their
margins, so that both blocks trained all of it. A pixel is in the strip if the point is that the
merged model's depth puts there. Three figures a border:

overlap_psnr    of one block's render against the other's, both uncropped, in the strip, dB: where
                they agree, it does not matter which of them is shown.
density_jump    ln of the gaussians in the second's half of the strip over those in the first's; the
                halves are of one size. What the reference has there is subtracted: a street beside
                a house has a jump in any model.
seam_db         PSNR that the merged model lacks in the strip: its gain over the reference elsewhere
                less that in the strip, mean of the views that show the strip, by how many pixels
                they show of it. PSNR itself differs from place to place by far more than a seam, as
                places differ in difficulty; that cancels against a model that was trained in one
                piece and has no seams. Errors summed over views instead would be those of the few
                corners that hardly a photo shows.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.evaluation.colour import fit_colour
from clsplat.evaluation.views import opened, photo_of, render_view
from clsplat.gaussians import Gaussians
from clsplat.options import TrainOptions
from clsplat.partition.partition import Partition
from clsplat.scene import Scene, View

STRIP = 0.1  # of the cells' sides, where blocks have no margin
OPAQUE = 0.5  # a pixel has a place if no more light than this passes
OVERLAP_VIEWS = 4  # a border, those that show most of it
LEAST_PIXELS = 500  # of a strip, and of the rest of a view; fewer say nothing
CHUNK = 1 << 20  # gaussians at once


@dataclass(frozen=True, eq=False)
class Border:
    """Two blocks that share a face. Coordinates are those of the partition's space.

    Attributes
    ----------
    first, second : the blocks, `first` on the low side of the face.
    axis : across the face.
    at : where the face is.
    low, high : float64[3], the strip.
    """

    first: int
    second: int
    axis: int
    at: float
    low: np.ndarray
    high: np.ndarray

    def side(self, coordinates: NDArray[np.float64]) -> NDArray[np.int8]:
        """int8[N]: of coordinates [N, 3], -1 in the first's half of the strip, 1 in the second's,
        0 elsewhere."""
        within = ((coordinates >= self.low) & (coordinates < self.high)).all(axis=1)
        half = np.where(coordinates[:, self.axis] < self.at, -1, 1)
        return np.where(within, half, 0).astype(np.int8)

    def pixels(self, coordinates: NDArray[np.float64]) -> NDArray[np.int64]:
        """int64[K]: which of coordinates [N, 3], those of a picture, are in the strip."""
        if not len(coordinates) or (coordinates.max(axis=0) < self.low).any() or (
                coordinates.min(axis=0) >= self.high).any():
            return np.empty(0, np.int64)  # most borders of a city are not in the picture
        return np.flatnonzero(self.side(coordinates))


def find_borders(partition: Partition) -> list[Border]:
    """The Borders of a Partition, each pair of neighbours once."""
    regions = partition.regions
    low, high = (np.array([getattr(region, end) for region in regions]) for end in ("low", "high"))
    borders = []
    for axis in range(3):
        for first, second in np.argwhere(high[:, None, axis] == low[None, :, axis]):
            begin, end = np.maximum(low[first], low[second]), np.minimum(high[first], high[second])
            begin[axis] = end[axis] = at = high[first, axis]
            thickness = min(region.side[axis] * (region.margin or STRIP)
                            for region in (regions[first], regions[second]))
            begin[axis] -= thickness
            end[axis] += thickness
            if (begin < end).all():
                borders.append(Border(int(first), int(second), axis, float(at), begin, end))
    return borders


def find_seams(device: Device, partition: Partition, scene: Scene, views: Sequence[View],
               options: TrainOptions, merged: Gaussians, counts: Sequence[int],
               reference: Gaussians, block_model: Callable[[int], Gaussians | None]
               ) -> dict[str, Any]:
    """Measure how much shows where blocks meet. All models are in the scene's frame.

    Parameters
    ----------
    device : an open device.
    partition : the blocks.
    scene : the whole.
    views : those of its views to look from, at the size to look at.
    options : how models are rendered.
    merged : the model, block after block.
    counts : how many gaussians of it each block gave.
    reference : a model trained in one piece: the coarse one, or another to compare with.
    block_model : a block's number -> its model, not cropped, or None.

    Returns
    -------
    {"borders": [a dict a border], "seam_db", "worst_seam_db", "views"}; None for a figure that
    nothing can be said about.
    """
    borders = find_borders(partition)
    on_device = functools.partial(opened, device, scene=scene, options=options)
    shown_in, errors = _inspect_views(borders, partition.space, scene.offset, views,
                                      on_device(merged), on_device(reference))
    overlaps = _overlaps(borders, shown_in, on_device, block_model)
    halves = _halves(borders, partition.space, merged.positions, counts, scene.offset)
    owner = partition.owner(reference.positions + scene.offset)
    base = _halves(borders, partition.space,
                   reference.positions[np.argsort(owner, kind="stable")],
                   np.bincount(owner, minlength=len(counts)), scene.offset)
    records = []
    for number, border in enumerate(borders):
        jump = _jump(halves[number]) - _jump(base[number])
        records.append({"blocks": [border.first, border.second], "overlap_psnr": overlaps[number],
                        "gaussians": halves[number].tolist(), "density_jump": jump,
                        **_scores(errors[number])})
    seams = [record["seam_db"] for record in records if record["seam_db"] is not None]
    return {"borders": records, "views": len(views), "worst_seam_db": max(seams, default=None),
            "seam_db": _scores(errors[-1])["seam_db"]}


def _inspect_views(borders, space, offset, views, merged, reference):
    """(shown_in, errors). shown_in: a border's [(pixels, view, flat indices int[K])], most pixels
    first, OVERLAP_VIEWS at most. errors: for each border and at last for all, [float64[2, 3] a
    view]: in the strip and elsewhere, pixels, squared errors of merged, and of reference."""
    shown_in, errors = [[] for _ in borders], [[] for _ in range(len(borders) + 1)]
    for view in views:
        image, place = _picture(merged, view.camera)
        known = np.isfinite(place).all(axis=-1)
        coordinates = space.to(place[known] + offset)
        photo = photo_of(view)
        wrong = [((fit_colour(shown, photo) - photo) ** 2).mean(axis=-1)[known]
                 for shown in (image, render_view(*reference, view.camera))]
        values = np.stack([np.ones_like(wrong[0]), *wrong], axis=-1)
        pixels, away = np.flatnonzero(known), np.ones(len(values), bool)
        strips = [(number, near) for number, border in enumerate(borders)
                  if len(near := border.pixels(coordinates))]
        for number, near in strips:
            shown_in[number].append((len(near), view, pixels[near]))
            shown_in[number] = sorted(shown_in[number], key=lambda seen: -seen[0])[:OVERLAP_VIEWS]
            away[near] = False
        if strips:
            strips.append((len(borders), np.flatnonzero(~away)))
        for number, near in strips:
            errors[number].append([values[near].sum(axis=0), values[away].sum(axis=0)])
    return shown_in, errors


def _picture(model, camera):
    """(float32[H, W, 3] in 0..1, float64[H, W, 3]: the point each pixel shows, nan where none)."""
    renderer, rows, degree = model
    frame = renderer.render(rows, renderer.pack(camera), camera.width, camera.height, degree, True)
    image = np.clip(frame.image.download().transpose(1, 2, 0), 0, 1)
    covered = 1 - frame.blended.transmittance.download().astype(np.float64)
    depth = np.where(covered > 1 - OPAQUE, frame.blended.depth.download(), np.nan)
    line, column = np.indices(depth.shape) + 0.5
    along = np.stack([(column - camera.centre[0]) / camera.focal[0],
                      (line - camera.centre[1]) / camera.focal[1], np.ones_like(line)], axis=-1)
    place = along * (depth / np.maximum(covered, OPAQUE))[..., None]
    return image, (place - camera.translation) @ camera.rotation


def _overlaps(borders, shown_in, on_device, block_model):
    """dB a border, or None: one block's render against its neighbour's. Each block is opened once.
    """
    shown = {}  # (border, block): its colours in the strip
    for block in sorted({block for border in borders for block in (border.first, border.second)}):
        own = [number for number, border in enumerate(borders)
               if block in (border.first, border.second) and shown_in[number]]
        gaussians = block_model(block) if own else None
        if gaussians is None:
            continue
        model, pictures = on_device(gaussians), {}
        for number in own:
            parts = []
            for _, view, pixels in shown_in[number]:
                if view.name not in pictures:
                    pictures[view.name] = render_view(*model, view.camera).reshape(-1, 3)
                parts.append(pictures[view.name][pixels])
            shown[number, block] = np.concatenate(parts)
    result = []
    for number, border in enumerate(borders):
        one, other = (shown.get((number, block)) for block in (border.first, border.second))
        enough = one is not None and other is not None and len(one) >= LEAST_PIXELS
        result.append(float(_psnr(np.mean((one.astype(np.float64) - other) ** 2))) if enough
                      else None)
    return result


def _halves(borders, space, positions, counts, offset):
    """int64[B, 2]: gaussians in either half of each strip; positions: block after block."""
    halves = np.zeros((len(borders), 2), np.int64)
    for block, (end, count) in enumerate(zip(np.cumsum(counts), counts)):
        own = [n for n, border in enumerate(borders) if block in (border.first, border.second)]
        for begin in range(end - count, end, CHUNK):
            coordinates = space.to(positions[begin:min(end, begin + CHUNK)] + offset)
            for number in own:
                side = borders[number].side(coordinates)
                halves[number] += (side < 0).sum(), (side > 0).sum()
    return halves


def _jump(halves):
    """ln of the second over the first; half a gaussian more, so that none has a logarithm."""
    return float(np.log((halves[1] + 0.5) / (halves[0] + 0.5)))


def _scores(errors):
    """What the errors of `_inspect_views` say of a border."""
    names = "psnr", "reference_psnr", "elsewhere_psnr", "elsewhere_reference_psnr"
    errors = np.reshape(errors, (-1, 2, 3))
    pixels = int(errors[:, 0, 0].sum())
    errors = errors[errors[..., 0].min(axis=1) >= LEAST_PIXELS]
    if not len(errors):
        return {"pixels": pixels, **dict.fromkeys(names), "seam_db": None}
    weights = errors[:, 0, 0]
    near, near_reference, far, far_reference = (
        float(np.average(_psnr(errors[:, where, model] / errors[:, where, 0]), weights=weights))
        for where in (0, 1) for model in (1, 2))
    return {"pixels": pixels, **dict(zip(names, (near, near_reference, far, far_reference))),
            "seam_db": (far - far_reference) - (near - near_reference)}


def _psnr(square):
    return -10 * np.log10(np.maximum(square, 1e-12))
