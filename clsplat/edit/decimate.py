"""Fewer gaussians that look almost the same: neighbours are merged, pair by pair.

To keep the most important gaussians instead, by what they contribute to the training views, leaves
holes where many faint ones lay over each other (docs/guide/edit.md has the measurement).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.edit.transform import half_axes
from clsplat.gaussians import Gaussians
from clsplat.io.models.values import opacities

NEIGHBOURS = 8  # with which a gaussian may be merged
ROUND_SHARE = 0.2  # of the gaussians that a round removes at most, the cheapest pairs first
COLOUR_WEIGHT = 10.0  # of a squared difference of colours beside a squared distance in sigmas
SIZE_WEIGHT = 0.1  # of a squared difference of logarithms of sizes
MOST_OPACITY = 0.99  # of a merged gaussian, as in the renderer
TINY = 1e-300


def decimated(gaussians: Gaussians, count: int, progress: Callable[[int, int], object] | None = None) -> Gaussians:
    """A model of fewer gaussians that looks almost the same.

    Neighbours of similar colour and size are merged, faint and small ones first. A merged
    gaussian has the mean, the covariance and the mean colour of the two, weighted by their masses,
    and an opacity that keeps the sum of these. Rows that are not merged stay as they are.

    Parameters
    ----------
    gaussians : the model; fields of SPHERE are left out.
    count : how many gaussians to keep, at least 1.
    progress : called with the number of gaussians that are removed, and to be removed.
    """
    gaussians = gaussians.without_spheres()
    count = max(1, count)
    mixture, goal = _mixture(gaussians), gaussians.count - count
    while len(mixture) > count:
        most = min(len(mixture) - count, max(1, int(ROUND_SHARE * len(mixture))))
        mixture = _merged(mixture, *_cheapest_pairs(mixture, most))
        if progress:
            progress(gaussians.count - len(mixture), goal)
    return _model(gaussians, mixture) if goal > 0 else gaussians


def _mixture(gaussians: Gaussians) -> NDArray[Any]:
    """A table of the gaussians. `source`: the row of the model that it was, or one of these; `mass`
    : opacity times area, how much of an image it covers."""
    mixture = np.zeros(
        gaussians.count,
        [
            ("source", np.intp),
            ("is_merged", bool),
            ("position", np.float64, 3),
            ("covariance", np.float64, (3, 3)),
            ("opacity", np.float64),
            ("mass", np.float64),
            ("sh", np.float32, (1 + gaussians.sh_rest.shape[1], 3)),
        ],
    )
    axes, sigmas = half_axes(gaussians), np.exp(gaussians.log_scales.astype(np.float64))
    mixture["source"] = np.arange(gaussians.count)
    mixture["position"] = gaussians.positions
    mixture["covariance"] = axes @ axes.transpose(0, 2, 1)
    mixture["opacity"] = opacities(gaussians)
    mixture["mass"] = mixture["opacity"] * np.sort(sigmas, axis=1)[:, 1:].prod(axis=1)
    mixture["sh"][:, 0], mixture["sh"][:, 1:] = gaussians.sh_constant, gaussians.sh_rest
    return mixture


def _cheapest_pairs(mixture: NDArray[Any], most: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Disjoint pairs of neighbours, at least one and at most `most`, the cheapest first."""
    positions, masses = mixture["position"], mixture["mass"]
    neighbours = min(NEIGHBOURS, len(mixture) - 1)
    found = scipy.spatial.cKDTree(positions).query(positions, k=neighbours + 1)[1]
    one, other = np.repeat(np.arange(len(mixture)), neighbours + 1), found.ravel()
    one, other = one[one != other], other[one != other]
    size = np.trace(mixture["covariance"], axis1=1, axis2=2) / 3 + TINY
    colours = SH_C0 * mixture["sh"][:, 0].astype(np.float64)
    apart = ((positions[one] - positions[other]) ** 2).sum(axis=1)
    # the sum of mass times squared way of both ends to their mean, as a share of the way between
    price = masses[one] * masses[other] / (masses[one] + masses[other] + TINY)
    cost = (price + TINY) * (
        apart / (size[one] + size[other])
        + COLOUR_WEIGHT * ((colours[one] - colours[other]) ** 2).sum(axis=1)
        + SIZE_WEIGHT * np.log(size[one] / size[other]) ** 2
    )
    order = np.argsort(cost, kind="stable")
    one, other, place = one[order], other[order], np.arange(len(order))
    # a pair is taken if it is the cheapest of both its ends
    first = np.full(len(mixture), len(order))
    for ends in (one, other):
        np.minimum.at(first, ends, place)
    taken = (first[one] == place) & (first[other] == place)
    return one[taken][:most], other[taken][:most]


def _merged(mixture: NDArray[Any], one: NDArray[np.intp], other: NDArray[np.intp]) -> NDArray[Any]:
    """The table after pairs of its rows are merged."""
    first, second = mixture[one], mixture[other]
    mass = first["mass"] + second["mass"]
    share = (first["mass"] / np.maximum(mass, TINY))[:, None]
    mean = second["position"] + share * (first["position"] - second["position"])
    covariance = np.zeros((len(one), 3, 3))
    for rows, part in ((first, share), (second, 1 - share)):
        away = rows["position"] - mean
        covariance += part[..., None] * (rows["covariance"] + away[:, :, None] * away[:, None])
    variances = np.linalg.eigvalsh(covariance)
    area = np.sqrt(np.maximum(variances[:, 1] * variances[:, 2], TINY))
    part = share[..., None].astype(np.float32)
    first["sh"] = part * first["sh"] + (1 - part) * second["sh"]
    first["position"], first["covariance"], first["is_merged"] = mean, covariance, True
    first["opacity"] = np.minimum(mass / area, MOST_OPACITY)
    first["mass"] = first["opacity"] * area
    mixture[one] = first
    return np.delete(mixture, other)


def _model(gaussians: Gaussians, mixture: NDArray[Any]) -> Gaussians:
    rows = {name: values[mixture["source"]] for name, values in gaussians.rows.items()}
    at = mixture["is_merged"]
    new = mixture[at]
    variances, axes = np.linalg.eigh(new["covariance"])
    axes[..., 0] *= np.sign(np.linalg.det(axes))[:, None]  # else some were mirrored
    rows["positions"][at] = new["position"]
    rows["sh_constant"][at], rows["sh_rest"][at] = new["sh"][:, 0], new["sh"][:, 1:]
    rows["opacity_logits"][at] = scipy.special.logit(np.maximum(new["opacity"], TINY))
    rows["log_scales"][at] = np.log(np.maximum(variances, np.finfo(np.float32).tiny)) / 2
    rows["quaternions"][at] = scipy.spatial.transform.Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    return Gaussians(rows, gaussians.sh_degree, gaussians.offset)
