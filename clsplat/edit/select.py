"""Some gaussians of a model, or those of several."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import ALPHA_STEPS
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.models.values import opacities

MOST_MEASURED = 1 << 17  # positions of a part that tell which of its sides is the longest
TAIL_SHARE = 0.01  # of positions at each end of each axis that do not make a part long


def selected(gaussians: Gaussians, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Gaussians:
    """Some gaussians of a model, without the fields of SPHERE.

    Parameters
    ----------
    keep : bool[N], or the rows in their new order.
    """
    return Gaussians(
        {field.name: gaussians.rows[field.name][keep] for field in LEARNED}, gaussians.sh_degree, gaussians.offset
    )


def used_sh_degree(gaussians: Gaussians) -> int:
    """The highest degree of the spherical harmonics that is not zero everywhere."""
    degree = gaussians.sh_degree
    while degree and not gaussians.sh_rest[:, degree**2 - 1 : (degree + 1) ** 2 - 1].any():
        degree -= 1
    return degree


def alive(gaussians: Gaussians) -> NDArray[np.bool_]:
    """bool[N]: whether gaussians are visible: the renderer skips alpha below 1 / ALPHA_STEPS."""
    return opacities(gaussians) >= 1 / ALPHA_STEPS


def halves(positions: NDArray[np.floating], rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of positions [N, 3], ascending, on both sides of a plane across the longest side of most
    of them: equal numbers, so that far outliers do not make parts of their own."""
    within = positions[rows]
    some = within[:: 1 + len(rows) // MOST_MEASURED]
    low, high = np.quantile(some, (TAIL_SHARE, 1 - TAIL_SHARE), axis=0)
    half = len(rows) // 2
    order = np.argpartition(within[:, np.argmax(high - low)], half)
    return np.sort(rows[order[:half]]), np.sort(rows[order[half:]])


def parted(positions: NDArray[np.floating], rows: NDArray[np.intp], most: int, rounds: int) -> list[NDArray[np.intp]]:
    """Rows of positions, more than `most`, in two to 2 ** `rounds` parts: in each round those of
    more than `most` rows become `halves`."""
    parts = [rows]
    for _ in range(rounds):
        parts = [half for part in parts for half in (halves(positions, part) if len(part) > most else (part,))]
    return parts


def mean_sigma(gaussians: Gaussians) -> float:
    """Mean standard deviation weighted by opacity, world units; 0 where all are transparent."""
    opacity = opacities(gaussians)
    sigma = np.exp(gaussians.log_scales.astype(np.float64)).mean(axis=1)
    return float(opacity @ sigma / max(opacity.sum(), np.finfo(float).tiny))


def merged(models: Sequence[Gaussians]) -> Gaussians:
    """One model of several, in order, in the local frame of the first, with the highest SH degree.

    Raises
    ------
    InputError : they lie so far apart that float32 cannot hold them together.
    """
    origin, degree = models[0].offset, max(model.sh_degree for model in models)
    pieces = [model.without_spheres().with_sh_degree(degree).moved(origin) for model in models]
    for piece, model in zip(pieces, models):
        away = piece.positions.astype(np.float64) - model.positions - (model.offset - origin)
        if model.count and np.abs(away).max() > np.exp(np.median(model.log_scales)):
            raise InputError(
                "the models lie too far apart to be merged: their coordinates would "
                "lose more than the size of a gaussian; transform them first"
            )
    return Gaussians(
        {field.name: np.concatenate([piece.rows[field.name] for piece in pieces]) for field in LEARNED}, degree, origin
    )
