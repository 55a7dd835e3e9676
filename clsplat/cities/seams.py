"""Seams: overlap, density and error along each border between blocks.

A border is the face that two cells share; its strip reaches into both by the smaller of their
margins, so that both blocks trained all of it. A pixel is in the strip if its point is, at the
depth of the merged model. Three figures for each border:

overlap_psnr    of one block's render against the other's, both uncropped, in the strip, dB: where
                they agree, it does not matter which of them is shown.
density_jump    ln of the gaussians in the second's half of the strip over those in the first's; the
                halves have the same size. The jump of the reference is subtracted, since a street
                beside a house has a jump in any model.
seam_db         PSNR that the merged model lacks in the strip: its gain over the reference elsewhere
                minus that in the strip, mean of the views that show the strip, weighted by the
                pixels that they show of it. PSNR itself differs from place to place by far more
                than a seam, as places differ in difficulty; that cancels against a model that was
                trained in one piece and has no seams. A sum of errors over views would be dominated
                by the few corners that hardly any photo shows.
"""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.evaluation.colour import fit_colour
from clsplat.evaluation.views import Image, opened, photo_of, render_view, scored_at_once
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.photos.views import read_valid
from clsplat.partition.partition import Partition
from clsplat.partition.region import Space
from clsplat.rendering.options import RenderingOptions
from clsplat.rendering.slabs import ModelRenderer
from clsplat.scene import Scene, View

STRIP = 0.1  # of the cells' sides, where blocks have no margin
OPAQUE = 0.5  # a pixel has a depth if its transmittance is below this
OVERLAP_VIEWS = 4  # for each border, those that show most of it
LEAST_PIXELS = 500  # of a strip, and of the rest of a view; fewer are too noisy
CHUNK = 1 << 20  # gaussians at once
MODELS_AHEAD = 2  # models of blocks that are read while another is drawn


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
        """[N]: for coordinates [N, 3], -1 in the first half of the strip, 1 in the second, else 0.
        """
        within = ((coordinates >= self.low) & (coordinates < self.high)).all(axis=1)
        half = np.where(coordinates[:, self.axis] < self.at, -1, 1)
        return np.where(within, half, 0).astype(np.int8)

    def pixels(self, coordinates: NDArray[np.float64]) -> NDArray[np.int64]:
        """[K]: the indices of those of a picture's coordinates [N, 3] that are in the strip."""
        if not len(coordinates) or (coordinates.max(axis=0) < self.low).any() or (
                coordinates.min(axis=0) >= self.high).any():
            return np.empty(0, np.int64)  # most borders of a city are not in the picture
        return np.flatnonzero(self.side(coordinates))


def find_borders(partition: Partition) -> list[Border]:
    """The borders of a partition, each pair of neighbours once."""
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


Model = tuple[ModelRenderer, Any, int]  # on a device, see `evaluation.views.opened`
Shown = tuple[int, int, NDArray[np.int64]]  # a strip in a view: pixels, view, flat indices [K]


@dataclass(frozen=True, eq=False)
class Strips:
    """What views show of the strips of borders, and the errors beside these.

    Attributes
    ----------
    shown : for each border (pixels, view, their flat indices [K]) of the OVERLAP_VIEWS views that
        show most of it; a view is an index.
    errors : for each border, and finally for all of them together, (view, float64[2, 3]): in the
        strip and elsewhere, the pixels and the squared errors of the merged model and the
        reference.
    """

    shown: list[list[Shown]]
    errors: list[list[tuple[int, NDArray[np.float64]]]]

    @classmethod
    def joined(cls, parts: Sequence["Strips"]) -> "Strips":
        """The Strips of all views from those of some of the views each."""
        return cls([_most([each for part in parts for each in part.shown[border]])
                    for border in range(len(parts[0].shown))],
                   [sorted((each for part in parts for each in part.errors[border]),
                           key=lambda error: error[0])
                    for border in range(len(parts[0].errors))])


def _most(seen: list[Shown]) -> list[Shown]:
    """The OVERLAP_VIEWS that show most, the first of those that show as much."""
    return sorted(seen, key=lambda shown: (-shown[0], shown[1]))[:OVERLAP_VIEWS]


def find_seams(device: Device, partition: Partition, scene: Scene, views: Sequence[View],
               options: RenderingOptions, merged: Gaussians, counts: NDArray[np.integer],
               reference: Gaussians, block_model: Callable[[int], Gaussians | None],
               strips: Strips | None = None) -> dict[str, Any]:
    """Measure how visible the seams between blocks are. All models are in the scene's frame.

    Parameters
    ----------
    device : an open device.
    partition : the blocks.
    scene : the whole.
    views : the views to render, at the size of the renders.
    options : how models are rendered.
    merged : the model, block after block.
    counts : how many of its gaussians each block owns.
    reference : a model trained in one piece: the coarse one, or another to compare with.
    block_model : a block's number -> its model, not cropped, or None.
    strips : the result of `inspect_views` for all views; None: it is computed here.

    Returns
    -------
    {"borders": [a dict for each border], "seam_db", "worst_seam_db", "views"}; figures that cannot
    be measured are None.
    """
    borders = find_borders(partition)
    on_device = functools.partial(opened, device, scene=scene, options=options)
    if strips is None:
        strips = inspect_views(device, partition, scene, views, options, merged, reference)
    errors = [[sums for _, sums in parts] for parts in strips.errors]
    overlaps = _overlaps(borders, strips.shown, views, on_device, block_model)
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


def inspect_views(device: Device, partition: Partition, scene: Scene, views: Sequence[View],
                  options: RenderingOptions, merged: Gaussians, reference: Gaussians,
                  chosen: Iterable[int] | None = None) -> Strips:
    """Where views show each border, and the errors beside it.

    Parameters
    ----------
    device, partition, scene, views, options, merged, reference : as for `find_seams`.
    chosen : indices of the views to inspect, ascending; None: all.
    """
    borders, space = find_borders(partition), partition.space
    on_device, other = (opened(device, model, scene, options) for model in (merged, reference))
    strips = Strips([[] for _ in borders], [[] for _ in range(len(borders) + 1)])

    def rendered() -> Iterator[tuple[int, Image, NDArray[np.float64], Image]]:
        for index in range(len(views)) if chosen is None else chosen:
            camera = views[index].camera
            yield index, *_picture(on_device, camera), render_view(*other, camera)

    def inspect(index: int, image: Image, place: NDArray[np.float64], reference: Image
                ) -> list[tuple[int, Shown | None, tuple[int, NDArray[np.float64]]]]:
        """(border, its strip, errors) for each border that the view shows, and for all."""
        known, valid = np.isfinite(place).all(axis=-1), read_valid(views[index])
        if valid is not None and not (known := known & valid).any():
            return []
        coordinates = space.to(place[known] + scene.offset)
        photo = photo_of(views[index])
        wrong = [((fit_colour(shown, photo, valid) - photo) ** 2).mean(axis=-1)[known]
                 for shown in (image, reference)]
        values = np.stack([np.ones_like(wrong[0]), *wrong], axis=-1)
        pixels, away = np.flatnonzero(known), np.ones(len(values), bool)
        near = [(number, inside) for number, border in enumerate(borders)
                if len(inside := border.pixels(coordinates))]
        for _, inside in near:
            away[inside] = False
        found: list[tuple[int, Shown | None, NDArray[np.int64]]] = [
            (number, (len(inside), index, pixels[inside]), inside) for number, inside in near]
        if near:
            found.append((len(borders), None, np.flatnonzero(~away)))
        return [(number, strip, (index, np.stack([values[inside].sum(axis=0),
                                                  values[away].sum(axis=0)])))
                for number, strip, inside in found]

    most = scored_at_once(views)
    for found in called_ahead(inspect, rendered(), most, most):
        for number, strip, errors in found:
            if strip:
                strips.shown[number][:] = _most([*strips.shown[number], strip])
            strips.errors[number].append(errors)
    return strips


def _picture(model: Model, camera: Camera) -> tuple[Image, NDArray[np.float64]]:
    """The image of a camera, and the point [H, W, 3] that each pixel shows; nan where none."""
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


def _overlaps(borders: list[Border], shown_in: list[list[Shown]], views: Sequence[View],
              on_device: Callable[[Gaussians], Model],
              block_model: Callable[[int], Gaussians | None]) -> list[float | None]:
    """PSNR, dB, of one block's render against its neighbour's, for each border that has both.

    Each block is opened once.
    """
    shown = {}  # (border, block): its colours in the strip
    borders_of = {block: own for block in sorted({
        block for border in borders for block in (border.first, border.second)})
        if (own := [number for number, border in enumerate(borders)
                    if block in (border.first, border.second) and shown_in[number]])}
    models = called_ahead(block_model, zip(borders_of), MODELS_AHEAD, MODELS_AHEAD)
    for (block, own), gaussians in zip(borders_of.items(), models):
        if gaussians is None:
            continue
        model = on_device(gaussians)
        pictures: dict[str, NDArray[np.floating]] = {}
        for number in own:
            parts = []
            for _, index, pixels in shown_in[number]:
                view = views[index]
                if view.name not in pictures:
                    pictures[view.name] = render_view(*model, view.camera).reshape(-1, 3)
                parts.append(pictures[view.name][pixels])
            shown[number, block] = np.concatenate(parts)
    result: list[float | None] = []
    for number, border in enumerate(borders):
        one, other = (shown.get((number, block)) for block in (border.first, border.second))
        if one is None or other is None or len(one) < LEAST_PIXELS:
            result.append(None)
        else:
            result.append(float(_psnr(np.mean((one.astype(np.float64) - other) ** 2))))
    return result


def _halves(borders: list[Border], space: Space, positions: NDArray[np.floating],
            counts: NDArray[np.integer], offset: NDArray[np.float64]
            ) -> NDArray[np.int64]:
    """[B, 2]: gaussians in either half of each strip, from positions block after block."""
    halves = np.zeros((len(borders), 2), np.int64)
    for block, (end, count) in enumerate(zip(np.cumsum(counts), counts)):
        own = [n for n, border in enumerate(borders) if block in (border.first, border.second)]
        for begin in range(end - count, end, CHUNK):
            coordinates = space.to(positions[begin:min(end, begin + CHUNK)] + offset)
            for number in own:
                side = borders[number].side(coordinates)
                halves[number] += (side < 0).sum(), (side > 0).sum()
    return halves


def _jump(halves: NDArray[np.int64]) -> float:
    """ln of the second over the first; both plus a half, since 0 does not have a logarithm."""
    return float(np.log((halves[1] + 0.5) / (halves[0] + 0.5)))


def _scores(errors: ArrayLike) -> dict[str, Any]:
    """The scores of a border from the errors of `_inspect_views`."""
    names = "psnr", "reference_psnr", "elsewhere_psnr", "elsewhere_reference_psnr"
    views: NDArray[np.float64] = np.reshape(errors, (-1, 2, 3))
    pixels = int(views[:, 0, 0].sum())
    views = views[views[..., 0].min(axis=1) >= LEAST_PIXELS]
    if not len(views):
        return {"pixels": pixels, **dict.fromkeys(names), "seam_db": None}
    weights = views[:, 0, 0]
    near, near_reference, far, far_reference = (
        float(np.average(_psnr(views[:, where, model] / views[:, where, 0]), weights=weights))
        for where in (0, 1) for model in (1, 2))
    return {"pixels": pixels, **dict(zip(names, (near, near_reference, far, far_reference))),
            "seam_db": (far - far_reference) - (near - near_reference)}


def _psnr(square: ArrayLike) -> Any:
    """PSNR, dB, of a squared error or several."""
    return -10 * np.log10(np.maximum(square, 1e-12))
