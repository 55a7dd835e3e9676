"""Seams: the error along each border between blocks.

A border is the face that two cells share; its strip reaches into both by the smaller of their
margins, so that both blocks trained all of it. A pixel is in the strip if its point is, at the
depth of the merged model.

seam_db         PSNR that the merged model lacks in the strip: its gain over the reference elsewhere
                minus that in the strip, mean of the views that show the strip, weighted by the
                pixels that they show of it. PSNR itself differs from place to place by far more
                than a seam, as places differ in difficulty; that cancels against a model that was
                trained in one piece and has no seams. A sum of errors over views would be dominated
                by the few corners that hardly any photo shows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from clsplat.evaluation.metrics import fit_colour
from clsplat.evaluation.views import Image, Model, photo_of, render_view, scored_at_once
from clsplat.io.ahead import called_ahead
from clsplat.io.photos.views import read_valid
from clsplat.partition.region import Partition
from clsplat.scene import Scene, View

STRIP = 0.1  # of the cells' sides, where blocks have no margin
OPAQUE = 0.5  # a pixel has a depth if its transmittance is below this
LEAST_PIXELS = 500  # of a strip, and of the rest of a view; fewer are too noisy


@dataclass(frozen=True, eq=False)
class Border:
    """The strip, from `low` [3] to `high` [3] in coordinates of the partition's space, at the face
    that two blocks share."""

    blocks: tuple[int, int]
    low: np.ndarray
    high: np.ndarray

    def pixels(self, coordinates: NDArray[np.float64]) -> NDArray[np.int64]:
        """[K]: the indices of those of a picture's coordinates [N, 3] that are in the strip."""
        if (
            not len(coordinates)
            or (coordinates.max(axis=0) < self.low).any()
            or (coordinates.min(axis=0) >= self.high).any()
        ):
            return np.empty(0, np.int64)  # most borders of a city are not in the picture
        return np.flatnonzero(((coordinates >= self.low) & (coordinates < self.high)).all(axis=1))


def find_borders(partition: Partition) -> list[Border]:
    """The borders of a partition, each pair of neighbours once."""
    regions = partition.regions
    low, high = (np.array([getattr(region, end) for region in regions]) for end in ("low", "high"))
    borders = []
    for axis in range(3):
        for first, second in np.argwhere(high[:, None, axis] == low[None, :, axis]).tolist():
            begin, end = np.maximum(low[first], low[second]), np.minimum(high[first], high[second])
            thickness = min(
                region.side[axis] * (region.margin or STRIP) for region in (regions[first], regions[second])
            )
            begin[axis], end[axis] = high[first, axis] + np.array([-thickness, thickness])
            if (begin < end).all():
                borders.append(Border((first, second), begin, end))
    return borders


def find_seams(
    partition: Partition, scene: Scene, views: Sequence[View], merged: Model, reference: Model
) -> dict[str, Any]:
    """How visible the seams between blocks are. All models are in the scene's frame.

    Parameters
    ----------
    partition, scene : the whole.
    views : at the size of the renders.
    merged : the model of all blocks, on a device.
    reference : a model trained in one piece: the coarse one, or another to compare with.

    Returns
    -------
    {"borders": [a dict for each border], "seam_db", "worst_seam_db", "views"}; figures that cannot
    be measured are None.
    """
    borders, space = find_borders(partition), partition.space
    # of each border, and finally of all of them together: a float64[2, 3] for each view, in the
    # strip and elsewhere, the pixels and the squared errors of the merged model and the reference
    errors: list[list[NDArray[np.float64]]] = [[] for _ in range(len(borders) + 1)]

    def rendered() -> Iterator[tuple[View, Image, Image, Image, Image]]:
        for view in views:
            yield view, *_picture(merged, view.camera), render_view(*reference, view.camera)

    def inspect(
        view: View, image: Image, transmittance: Image, depth: Image, other: Image
    ) -> list[tuple[int, NDArray[np.float64]]]:
        """(border, errors) for each border that the view shows, and for all."""
        place = _places(view.camera, transmittance, depth)
        known, valid = np.isfinite(place).all(axis=-1), read_valid(view)
        if valid is not None and not (known := known & valid).any():
            return []
        coordinates = space.to(place[known] + scene.offset)
        near = [(number, inside) for number, border in enumerate(borders) if len(inside := border.pixels(coordinates))]
        if not near:
            return []
        photo = photo_of(view)
        wrong = [((fit_colour(shown, photo, valid) - photo) ** 2).mean(axis=-1)[known] for shown in (image, other)]
        values = np.stack([np.ones_like(wrong[0]), *wrong], axis=-1)
        away = np.ones(len(values), bool)
        for _, inside in near:
            away[inside] = False
        near.append((len(borders), np.flatnonzero(~away)))
        return [(number, np.stack([values[inside].sum(axis=0), values[away].sum(axis=0)])) for number, inside in near]

    most = scored_at_once(views)
    for found in called_ahead(inspect, rendered(), most, most):
        for number, of_view in found:
            errors[number].append(of_view)
    scores = [_scores(of_border) for of_border in errors]
    records = [{"blocks": list(border.blocks), **each} for border, each in zip(borders, scores)]
    seams = [record["seam_db"] for record in records if record["seam_db"] is not None]
    return {
        "borders": records,
        "views": len(views),
        "worst_seam_db": max(seams, default=None),
        "seam_db": scores[-1]["seam_db"],
    }


def _picture(model: Model, camera: Camera) -> tuple[Image, Image, Image]:
    """The image of a camera, and its transmittance and blended depth [H, W]."""
    renderer, rows, degree = model
    frame = renderer.render(rows, renderer.pack(camera), camera.width, camera.height, degree, True)
    image = np.clip(frame.image.download().transpose(1, 2, 0), 0, 1)
    return image, frame.blended.transmittance.download(), frame.blended.depth.download()


def _places(camera: Camera, transmittance: Image, depth: Image) -> NDArray[np.float64]:
    """The point [H, W, 3] that each pixel shows; nan where none."""
    covered = 1 - transmittance.astype(np.float64)
    depth = np.where(covered > 1 - OPAQUE, depth, np.nan)
    line, column = np.indices(depth.shape) + 0.5
    along = np.stack(
        [
            (column - camera.centre[0]) / camera.focal[0],
            (line - camera.centre[1]) / camera.focal[1],
            np.ones_like(line),
        ],
        axis=-1,
    )
    place = along * (depth / np.maximum(covered, OPAQUE))[..., None]
    place -= camera.translation
    return place @ camera.rotation


def _scores(errors: ArrayLike) -> dict[str, Any]:
    """The scores of a border from its errors in each view."""
    names = "psnr", "reference_psnr", "elsewhere_psnr", "elsewhere_reference_psnr"
    views: NDArray[np.float64] = np.reshape(errors, (-1, 2, 3))
    pixels = int(views[:, 0, 0].sum())
    views = views[views[..., 0].min(axis=1) >= LEAST_PIXELS]
    if not len(views):
        return {"pixels": pixels, **dict.fromkeys(names), "seam_db": None}
    weights = views[:, 0, 0]
    near, near_reference, far, far_reference = (
        float(np.average(_psnr(views[:, where, model] / views[:, where, 0]), weights=weights))
        for where in (0, 1)
        for model in (1, 2)
    )
    return {
        "pixels": pixels,
        **dict(zip(names, (near, near_reference, far, far_reference))),
        "seam_db": (far - far_reference) - (near - near_reference),
    }


def _psnr(square: ArrayLike) -> Any:
    """PSNR, dB, of a squared error or several."""
    return -10 * np.log10(np.maximum(square, 1e-12))
