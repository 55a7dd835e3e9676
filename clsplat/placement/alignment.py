"""Aligns a reconstruction with measured positions of its cameras or of ground control points.

Positions by GPS have errors of very different size along the ground and upwards, and some of them
are grossly wrong. Heights may drift by tens of metres during a flight, may be above anything, or be
missing. So horizontal and vertical residuals are judged apart: each kind has a standard deviation
that is estimated with the similarity (iteratively reweighted least squares, Cauchy's weights).
Errors of heights change slowly during a flight, so that all heights together count as few
measurements. What they leave open of the tilt of the scene, follows from the direction that the
cameras and points show as up. Thus good heights level the scene, and bad ones neither tilt nor
scale it.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.placement.up import UP, Vertical

LEAST_POSITIONS = 3
LEAST_STD = 0.01  # metres; smaller ones of positions are not believed
BENDING = 0.005  # of the distances between positions: so much every reconstruction is bent
INDEPENDENT_HEIGHTS = 6  # as so many measurements all heights of photos count
SAMPLES = 300  # minimal sets of positions from which a start is computed
ITERATIONS = 50
CAUCHY = 2.385**2  # variances from which on weights fall; 95 % efficient without outliers
MOST_RIGHT = 0.7  # at least this share of the positions is taken to be right
OUTLIER = 4.0  # standard deviations beyond which a position is reported as wrong
# of the size of the positions that residuals may have; 40 random positions have 0.19 at least
LARGEST_SHARE = 0.17
LARGEST_STEP = 1.0  # of the logarithm of the scale and of angles, radians, in one iteration


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation @ x + translation.

    Attributes
    ----------
    scale, rotation, translation : above 0, float64[3, 3], and float64[3] in target units.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def __call__(self, points: ArrayLike) -> NDArray[np.float64]:
        """Transform points float[N, 3]."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a reconstruction lies among measured positions.

    Attributes
    ----------
    similarity : from the reconstruction to the positions' axes: east, north, up, metres.
    used, used_heights : bool[N], which positions agree with it along the ground, and which heights
        do; the others are outliers.
    horizontal, vertical : metres, RMS of the residuals of those that are used, along the ground and
        upwards; vertical is nan without heights.
    stands : whether it is neither upside down nor tilted far from the vertical that is known.
    size : metres, the diagonal along the ground of the positions that are used.
    """

    similarity: Similarity
    used: NDArray[np.bool_]
    used_heights: NDArray[np.bool_]
    horizontal: float
    vertical: float
    stands: bool
    size: float


def aligned(
    places: ArrayLike,
    positions: ArrayLike,
    vertical: Vertical,
    *,
    std: ArrayLike | None = None,
    is_control: bool = False,
) -> Alignment | None:
    """Align places in a reconstruction with their measured positions.

    Parameters
    ----------
    places : float[N, 3], in the reconstruction: camera centres or control points.
    positions : float[N, 3], east, north, up, metres; nan for what is unknown.
    vertical : what is known of it in the reconstruction.
    std : float[N, 3], metres, standard deviations of the positions, of which only ratios count;
        None: all are equal.
    is_control : whether heights are as right as the rest, as those of ground control points are.

    Returns
    -------
    None if the positions do not determine where the reconstruction lies: they are fewer than three,
    at one place, or contradict each other. A result that stands is preferred to one that does not,
    even if it fits worse.
    """
    places, positions = (np.asarray(values, np.float64).reshape(-1, 3) for values in (places, positions))
    known: NDArray[np.bool_] = np.all(np.isfinite(np.column_stack([positions[:, :2], places])), axis=1)
    if known.sum() < LEAST_POSITIONS:
        return None
    deviations = np.ones(positions.shape) if std is None else np.asarray(std, np.float64)
    problem = _Problem(places, positions, known, vertical, deviations, is_control)
    rng = np.random.default_rng(0)
    found = [
        problem.judged(end)
        for start in (problem.level_start(rng), problem.free_start(rng))
        if start is not None and (end := problem.refined(start)) is not None
    ]
    consistent = [
        each for each in found if each.used.sum() >= LEAST_POSITIONS and each.horizontal < LARGEST_SHARE * each.size
    ]
    return min(consistent, key=lambda each: (not each.stands, each.horizontal), default=None)


class _Problem:
    """The measurements of an alignment, those that are known; its parameters are a Similarity."""

    def __init__(
        self,
        places: NDArray[np.float64],
        positions: NDArray[np.float64],
        known: NDArray[np.bool_],
        vertical: Vertical,
        std: NDArray[np.float64],
        is_control: bool,
    ) -> None:
        self.known, self.places, self.vertical = known, places[known], vertical
        self.up, self.up_std = vertical.up, np.radians(vertical.degrees)
        deviations = np.maximum(std[known], LEAST_STD)
        # relative to the typical one, so that estimated standard deviations are in metres
        self.horizontal_std = np.sqrt((deviations[:, :2] ** 2).mean(axis=1))
        self.horizontal_std /= np.median(self.horizontal_std)
        self.vertical_std = deviations[:, 2] / np.median(deviations[:, 2])
        self.has_height = np.isfinite(positions[known, 2])
        self.height_share = 1.0 if is_control else min(1.0, INDEPENDENT_HEIGHTS / max(int(self.has_height.sum()), 1))
        self.positions = np.where(np.isfinite(positions[known]), positions[known], 0.0)
        flat = self.positions[:, :2]
        self.least_std = max(
            LEAST_STD, BENDING * float(np.median(np.linalg.norm(flat - np.median(flat, axis=0), axis=1)))
        )

    def residuals(self, similarity: Similarity) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Vectors [N, 2] along the ground and numbers [N] upwards, metres; 0 without a height."""
        away = similarity(self.places) - self.positions
        return away[:, :2], np.where(self.has_height, away[:, 2], 0.0)

    def level_start(self, rng: np.random.Generator) -> Similarity | None:
        """One that fits most of the positions along the ground, with the given direction upwards."""
        rotation = scipy.spatial.transform.Rotation.align_vectors(UP, self.up)[0].as_matrix()
        turned = self.places @ rotation.T
        place, position = (values[:, 0] + 1j * values[:, 1] for values in (turned, self.positions))
        first, second = _samples(rng, len(place), 2).T
        with np.errstate(all="ignore"):
            factors = (position[second] - position[first]) / (place[second] - place[first])
            shifts = position[first] - factors * place[first]
            away = factors[:, None] * place + shifts[:, None] - position
            errors = np.quantile(np.abs(away) / self.horizontal_std, MOST_RIGHT, axis=1)
        errors[~np.isfinite(errors) | (factors == 0)] = np.inf
        if not (errors < np.inf).any():
            return None
        factor, shift = (values[errors.argmin()] for values in (factors, shifts))
        turn = scipy.spatial.transform.Rotation.from_euler("z", np.angle(factor)).as_matrix()
        scale = abs(factor)
        heights = (self.positions[:, 2] - scale * turned[:, 2])[self.has_height]
        return Similarity(
            scale, turn @ rotation, np.array([shift.real, shift.imag, np.median(heights) if len(heights) else 0.0])
        )

    def free_start(self, rng: np.random.Generator) -> Similarity | None:
        """One that fits most of the positions that have heights."""
        places, positions, std = (
            values[self.has_height] for values in (self.places, self.positions, self.horizontal_std)
        )
        rows = _samples(rng, len(places), 3)
        scales, rotations, shifts = _fits(places[rows], positions[rows])
        if not len(scales):
            return None
        away = scales[:, None, None] * (places @ rotations.swapaxes(1, 2)) + shifts[:, None] - positions
        best = np.quantile(np.linalg.norm(away, axis=2) / std, MOST_RIGHT, axis=1).argmin()
        return Similarity(float(scales[best]), rotations[best], shifts[best])

    def _deviations(self, similarity: Similarity) -> tuple[float, float]:
        """Robust standard deviations, along one axis of the ground and upwards, metres."""
        horizontal, vertical = self.residuals(similarity)
        ground = np.linalg.norm(horizontal, axis=1) / self.horizontal_std
        height = (np.abs(vertical) / self.vertical_std)[self.has_height]
        # what MOST_RIGHT of the lengths do not exceed is 1.552 standard deviations along the ground
        # (Rayleigh distribution) and 1.036 in height (half-normal)
        ground_std, height_std = (
            _rms(values[values <= OUTLIER * np.quantile(values, MOST_RIGHT) / quantile]) if len(values) else np.inf
            for values, quantile in ((ground, 1.552), (height, 1.036))
        )
        return max(ground_std / np.sqrt(2), self.least_std), max(height_std, self.least_std)

    def refined(self, start: Similarity) -> Similarity | None:
        """The similarity at which reweighted least squares end; None if they diverge."""
        similarity = start
        for _ in range(ITERATIONS):
            step = self._step(similarity)
            if step is None:
                return None
            step *= min(1.0, LARGEST_STEP / max(float(np.abs(step[:4]).max()), LARGEST_STEP))
            scale, turn, shift = np.exp(step[0]), step[1:4], step[4:]
            middle = similarity(self.places).mean(axis=0)
            rotation = scipy.spatial.transform.Rotation.from_rotvec(turn).as_matrix()
            similarity = Similarity(
                similarity.scale * scale,
                rotation @ similarity.rotation,
                scale * rotation @ (similarity.translation - middle) + middle + shift,
            )
            if np.abs(step[:4]).max() < 1e-8:
                break
        return similarity

    def _step(self, similarity: Similarity) -> NDArray[np.float64] | None:
        """The Gauss-Newton step: logarithm of the scale, rotation vector [3], translation [3]; None
        if there is none, as with squares that floats do not hold."""
        horizontal, vertical = self.residuals(similarity)
        away = similarity(self.places)
        away -= away.mean(axis=0)
        x, y, _ = away.T
        columns = np.zeros((len(away), 3, 7))
        columns[:, :, 0] = away
        columns[:, :, 4:] = np.eye(3)
        columns[:, 0, 3], columns[:, 1, 3] = -y, x
        # Only heights show the tilt. It also shortens the ground, but by its cosine: the slightest
        # bending of the reconstruction would look like a large tilt.
        columns[:, 2, 1], columns[:, 2, 2] = y, -x
        errors = np.column_stack([horizontal, vertical])
        root = np.sqrt(self._weights(similarity, horizontal, vertical))[:, :, None]
        up = similarity.rotation @ self.up
        prior = np.zeros((2, 7))
        prior[:, 1:4] = np.cross(up, np.eye(3))[:2]
        tilt = float(np.arccos(np.clip(up[2], -1, 1)))
        weight = 1 / np.sqrt(self.up_std**2 + tilt**2 / CAUCHY)
        matrix = np.concatenate([(root * columns).reshape(-1, 7), weight * prior])
        away_from_up = up[:2] / (np.linalg.norm(up[:2]) or 1.0)
        vector = np.concatenate([(root[:, :, 0] * errors).ravel(), weight * tilt * away_from_up])
        if not (np.isfinite(matrix).all() and np.isfinite(vector).all()):
            return None
        step: NDArray[np.float64] = -np.linalg.lstsq(matrix, vector, rcond=1e-12)[0]
        return step

    def _weights(
        self, similarity: Similarity, horizontal: NDArray[np.float64], vertical: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Weights [N, 3] of squared residuals, 1 / metres^2."""
        ground_std, height_std = self._deviations(similarity)
        ground = 1 / ((ground_std * self.horizontal_std) ** 2 + (horizontal**2).sum(axis=1) / CAUCHY)
        height = self.has_height * self.height_share / ((height_std * self.vertical_std) ** 2 + vertical**2 / CAUCHY)
        return np.column_stack([ground, ground, height])

    def judged(self, similarity: Similarity) -> Alignment:
        """The result, with its residuals."""
        horizontal, vertical = self.residuals(similarity)
        ground_std, height_std = self._deviations(similarity)
        ground = np.linalg.norm(horizontal, axis=1)
        right = ground <= OUTLIER * ground_std * self.horizontal_std
        level = self.has_height & (np.abs(vertical) <= OUTLIER * height_std * self.vertical_std)
        used, used_heights = np.zeros((2, len(self.known)), bool)
        used[self.known], used_heights[self.known] = right, level
        flat = self.positions[right, :2]
        return Alignment(
            similarity,
            used,
            used_heights,
            _rms(ground[right]),
            _rms(vertical[right & level]),
            self.vertical.stands(similarity.rotation),
            float(np.linalg.norm(np.ptp(flat, axis=0))) if len(flat) else 0.0,
        )


def fitted(source: NDArray[np.float64], target: NDArray[np.float64]) -> Similarity | None:
    """The similarity with the least squared distances between points (Umeyama 1991).

    Parameters
    ----------
    source, target : float64[N, 3], the points and where they come to.

    Returns
    -------
    None if they determine none.
    """
    scales, rotations, shifts = _fits(source[None], target[None])
    return Similarity(float(scales[0]), rotations[0], shifts[0]) if len(scales) else None


def _fits(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Scales [F], rotations [F, 3, 3] and translations [F, 3] of those of the similarities between
    sets of points [S, N, 3] that these determine."""
    places, positions = (points - points.mean(axis=1, keepdims=True) for points in (source, target))
    product = positions.swapaxes(1, 2) @ places
    usable = np.isfinite(product).all(axis=(1, 2))
    left, values, right = np.linalg.svd(np.where(usable[:, None, None], product, 0))
    usable &= values[:, 1] > 1e-9 * np.linalg.norm(product, axis=(1, 2))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]  # no mirror
    rotations = left @ right
    scales = (positions * (places @ rotations.swapaxes(1, 2))).sum(axis=(1, 2)) / np.maximum(
        (places**2).sum(axis=(1, 2)), np.finfo(np.float64).tiny
    )
    shifts = target.mean(axis=1) - scales[:, None] * np.einsum("sij,sj->si", rotations, source.mean(axis=1))
    return scales[usable], rotations[usable], shifts[usable]


def _samples(rng: np.random.Generator, count: int, size: int) -> NDArray[np.intp]:
    """Distinct indices [S, size]."""
    if count < size:
        return np.zeros((0, size), np.intp)
    return np.array([rng.choice(count, size, replace=False) for _ in range(SAMPLES)])


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
