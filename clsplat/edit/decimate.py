"""Fewer gaussians that look almost the same: neighbours are merged, pair by pair.

To keep the most important gaussians instead, by what they contribute to the training views, leaves
holes where many faint ones lay over each other (docs/guide/edit.md has the measurement).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import logit

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


@dataclass(eq=False)
class _Mixture:
    """Gaussians while they are merged; arrays have a row each."""

    source: NDArray[np.intp]  # [N], the row of the model that it was, or one of those
    merged: NDArray[np.bool_]  # [N], whether it is more than one row of the model
    positions: NDArray[np.float64]  # [N, 3]
    covariances: NDArray[np.float64]  # [N, 3, 3]
    sh: NDArray[np.float32]  # [N, 1 + bands, 3]
    opacities: NDArray[np.float64]  # [N]
    masses: NDArray[np.float64]  # [N], opacity times area: how much of an image it covers

    @property
    def count(self) -> int:
        return len(self.source)

    def keep(self, rows: NDArray[np.bool_]) -> None:
        for field in fields(self):
            setattr(self, field.name, getattr(self, field.name)[rows])


def decimated(gaussians: Gaussians, count: int,
              progress: Callable[[int, int], object] | None = None) -> Gaussians:
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
    while mixture.count > count:
        most = min(mixture.count - count, max(1, int(ROUND_SHARE * mixture.count)))
        _merge(mixture, *_cheapest_pairs(mixture, most))
        if progress:
            progress(gaussians.count - mixture.count, goal)
    return _model(gaussians, mixture) if goal > 0 else gaussians


def _mixture(gaussians: Gaussians) -> _Mixture:
    sigmas = np.exp(gaussians.log_scales.astype(np.float64))
    opacity, axes = opacities(gaussians), half_axes(gaussians)
    masses = opacity * np.sort(sigmas, axis=1)[:, 1:].prod(axis=1)
    return _Mixture(
        np.arange(gaussians.count), np.zeros(gaussians.count, bool),
        gaussians.positions.astype(np.float64), axes @ axes.transpose(0, 2, 1),
        np.concatenate([gaussians.sh_constant[:, None], gaussians.sh_rest], axis=1), opacity,
        masses)


def _cheapest_pairs(mixture: _Mixture, most: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Disjoint pairs of neighbours, at least one and at most `most`, the cheapest first."""
    neighbours = min(NEIGHBOURS, mixture.count - 1)
    found = cKDTree(mixture.positions).query(mixture.positions, k=neighbours + 1)[1]
    one, other = np.repeat(np.arange(mixture.count), neighbours + 1), found.ravel()
    one, other = one[one != other], other[one != other]
    size = np.trace(mixture.covariances, axis1=1, axis2=2) / 3 + TINY
    colours = SH_C0 * mixture.sh[:, 0].astype(np.float64)
    apart = ((mixture.positions[one] - mixture.positions[other]) ** 2).sum(axis=1)
    # the sum of mass times squared way of both ends to their mean, as a share of the way between
    price = mixture.masses[one] * mixture.masses[other] / (
        mixture.masses[one] + mixture.masses[other] + TINY)
    cost = (price + TINY) * (
        apart / (size[one] + size[other])
        + COLOUR_WEIGHT * ((colours[one] - colours[other]) ** 2).sum(axis=1)
        + SIZE_WEIGHT * np.log(size[one] / size[other]) ** 2)
    order = np.argsort(cost, kind="stable")
    one, other, place = one[order], other[order], np.arange(len(order))
    # a pair is taken if it is the cheapest of both its ends
    first = np.full(mixture.count, len(order))
    for ends in (one, other):
        np.minimum.at(first, ends, place)
    taken = (first[one] == place) & (first[other] == place)
    return one[taken][:most], other[taken][:most]


def _merge(mixture: _Mixture, one: NDArray[np.intp], other: NDArray[np.intp]) -> None:
    """Merge pairs of gaussians into the first of each."""
    share = mixture.masses[one] / np.maximum(mixture.masses[one] + mixture.masses[other], TINY)
    mean = mixture.positions[other] + share[:, None] * (
        mixture.positions[one] - mixture.positions[other])
    covariance = np.zeros((len(one), 3, 3))
    for rows, part in ((one, share), (other, 1 - share)):
        away = mixture.positions[rows] - mean
        covariance += part[:, None, None] * (
            mixture.covariances[rows] + away[:, :, None] * away[:, None])
    part = share[:, None, None].astype(np.float32)
    mixture.sh[one] = part * mixture.sh[one] + (1 - part) * mixture.sh[other]
    mixture.positions[one], mixture.covariances[one] = mean, covariance
    variances = np.linalg.eigvalsh(covariance)
    area = np.sqrt(np.maximum(variances[:, 1] * variances[:, 2], TINY))
    mass = mixture.masses[one] + mixture.masses[other]
    mixture.opacities[one] = np.minimum(mass / area, MOST_OPACITY)
    mixture.masses[one] = mixture.opacities[one] * area
    mixture.merged[one] = True
    rest = np.ones(mixture.count, bool)
    rest[other] = False
    mixture.keep(rest)


def _model(gaussians: Gaussians, mixture: _Mixture) -> Gaussians:
    rows = {name: values[mixture.source] for name, values in gaussians.rows.items()}
    new = mixture.merged
    variances, axes = np.linalg.eigh(mixture.covariances[new])
    axes[..., 0] *= np.sign(np.linalg.det(axes))[:, None]  # else some were mirrored
    rows["positions"][new] = mixture.positions[new]
    rows["sh_constant"][new], rows["sh_rest"][new] = mixture.sh[new, 0], mixture.sh[new, 1:]
    rows["opacity_logits"][new] = logit(np.maximum(mixture.opacities[new], TINY))
    rows["log_scales"][new] = np.log(np.maximum(variances, np.finfo(np.float32).tiny)) / 2
    rows["quaternions"][new] = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    return Gaussians(rows, gaussians.sh_degree, gaussians.offset)
