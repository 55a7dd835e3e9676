"""Random flights whose measured positions have the gross errors that people make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.io.georeference.crs import outside
from clsplat.placement.alignment import Alignment
from clsplat.placement.plausible import Guess, NotGeoreferenced, believed, doubts
from clsplat.placement.up import Vertical

HEIGHT = 80.0  # metres of a flight above ground
Positions = NDArray[np.float64]
Mistake = Callable[[np.random.Generator, Positions], Positions]


def _some(rng: np.random.Generator, positions: Positions, most: float) -> NDArray[np.bool_]:
    """A random part of the rows, one or more."""
    chosen = rng.random(len(positions)) < rng.uniform(0, most)
    chosen[rng.integers(len(positions))] = True
    return chosen


def _outliers(rng: np.random.Generator, positions: Positions) -> Positions:
    rows = _some(rng, positions, 0.6)[:, None]
    return positions + rows * rng.normal(0, 10.0 ** rng.uniform(1, 9), positions.shape)


def _exchanged_some(rng: np.random.Generator, positions: Positions) -> Positions:
    return np.where(_some(rng, positions, 1.0)[:, None], positions[:, [1, 0, 2]], positions)


def _signs_some(rng: np.random.Generator, positions: Positions) -> Positions:
    rows = _some(rng, positions, 1.0)
    result = positions.copy()
    result[rows, rng.integers(2)] *= -1
    return result


def _duplicates(rng: np.random.Generator, positions: Positions) -> Positions:
    rows = _some(rng, positions, 1.0)
    return np.where(rows[:, None], positions[rng.integers(len(positions))], positions)


def _heights(rng: np.random.Generator, positions: Positions) -> Positions:
    result = positions.copy()
    result[:, 2] += rng.normal(0, 10.0 ** rng.uniform(1, 12), len(positions))
    return result


def _missing(rng: np.random.Generator, positions: Positions) -> Positions:
    return np.where(rng.random(positions.shape) < rng.uniform(0, 0.7), np.nan, positions)


def _line(rng: np.random.Generator, positions: Positions) -> Positions:
    middle = positions.mean(axis=0)
    return middle + (positions - middle) * (1, 1e-9, 1) @ Rotation.from_euler("z", rng.uniform(0, 6)).as_matrix()


def _shuffled(rng: np.random.Generator, positions: Positions) -> Positions:
    return positions[rng.permutation(len(positions))]


MISTAKES: dict[str, Mistake] = {
    "none": lambda rng, positions: positions,
    "far outliers": _outliers,
    "x and y exchanged": lambda rng, positions: positions[:, [1, 0, 2]],
    "x and y of some exchanged": _exchanged_some,
    "east mirrored": lambda rng, positions: positions * (-1, 1, 1),
    "north mirrored": lambda rng, positions: positions * (1, -1, 1),
    "wrong signs of some": _signs_some,
    "both axes negative": lambda rng, positions: positions * (-1, -1, 1),
    "heights negative": lambda rng, positions: positions * (1, 1, -1),
    "heights in feet": lambda rng, positions: positions / (1, 1, 0.3048),
    "huge heights": _heights,
    "duplicates": _duplicates,
    "constant": lambda rng, positions: np.tile(positions[0], (len(positions), 1)),
    "on one line": _line,
    "missing numbers": _missing,
    "other names": _shuffled,
    "noise": lambda rng, positions: positions + rng.normal(0, 10.0 ** rng.uniform(0, 3), positions.shape),
}


OF_THE_PLACE = ("both axes negative",)  # a turn, which shapes do not show


@dataclass(frozen=True)
class Outcome:
    """What became of a random flight.

    Attributes
    ----------
    kind : "refused", "warned" or "believed".
    right : whether the result is within 30 degrees and 5 % of scale of the truth, and its cameras
        within 10 % of the scene's size with the height of the flight; False if it was refused.
    said : why it was refused, or the warnings.
    """

    kind: str
    right: bool
    said: str


def outcome(mistake: str, seed: int) -> Outcome:
    """Align a random flight, or random control points below it, with such a mistake."""
    rng = np.random.default_rng(seed)
    is_control = bool(rng.integers(2))
    true, rotations, ground = _flight(rng)
    measured = ground[rng.choice(len(ground), rng.integers(3, 12), False)] if is_control else true
    turn, scale = Rotation.random(random_state=seed).as_matrix(), 10.0 ** rng.uniform(-2, 2)

    def places(points: Positions) -> Positions:
        return points @ turn.T / scale + (1, 2, 3)

    if rng.random() < 0.3:
        vertical = Vertical.measured(
            turn @ Rotation.from_euler("xy", rng.normal(0, 1, 2), degrees=True).as_matrix()[:, 2]
        )
    else:
        vertical = Vertical.by_cameras(rotations @ turn.T, places(ground))
    noise = 0.02 if is_control else 10.0 ** rng.uniform(-2, 0.5)
    origin = np.array([5e5, 5e6, 300.0])
    noisy = measured + rng.normal(0, noise, measured.shape)
    if mistake in OF_THE_PLACE or rng.random() < 0.3:
        positions = MISTAKES[mistake](rng, origin + noisy)
        known = np.isfinite(positions[:, 0])
        if known.any() and outside("EPSG:32632", positions[known]):
            return Outcome("refused", False, "outside")
    else:  # of numbers that are right in size, so that only the shape shows it
        middle = noisy.mean(axis=0)
        positions = MISTAKES[mistake](rng, noisy - middle) + middle + origin
    guesses = [
        Guess("exchanged?", positions[:, [1, 0, 2]]),
        Guess("heights down?", positions * (1, 1, -1)),
        Guess("feet?", positions * (1, 1, 0.3048)),
    ]
    try:
        result = believed(
            places(measured), positions, vertical, guesses if is_control else guesses[:1], is_control=is_control
        )
    except NotGeoreferenced as error:
        return Outcome("refused", False, str(error))
    said = doubts(result, positions, vertical, (result.horizontal, result.vertical), is_control)
    return Outcome(
        "warned" if said else "believed", _is_right(result, turn, scale, places(true), origin + true), "; ".join(said)
    )


def _flight(rng: np.random.Generator) -> tuple[Positions, Positions, Positions]:
    """Cameras [N, 3], their rotations, and points on the ground, metres: a grid, one strip, or
    few photos, straight down or oblique, over flat or hilly ground."""
    kind = rng.integers(3)
    rows, columns = ((rng.integers(2, 6), rng.integers(3, 9)), (1, rng.integers(5, 12)), (1, rng.integers(3, 5)))[kind]
    spacing = rng.uniform(5, 40)
    x, y = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing * 1.3)
    true = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT)])
    true += rng.normal(0, (0.03, 0.3)[rng.integers(2)] * spacing, true.shape) * (1, 1, 0.2)
    pitch = rng.uniform(0, 45) * rng.integers(2)
    yaws = 180 * (y.ravel() / spacing / 1.3 % 2) + rng.normal(0, 3, x.size)
    body = Rotation.from_euler("ZX", np.column_stack([yaws, np.full(x.size, pitch)]), degrees=True)
    rotations = np.diag([1.0, -1.0, -1.0]) @ body.inv().as_matrix()  # x right, y down, z forward
    spread = max(np.ptp(true[:, :2], axis=0).max(), 40)
    ground = rng.uniform(-0.3, 1.3, (300, 3)) * spread
    ground[:, 2] = rng.uniform(0, 8) * np.sin(ground[:, 0] / 15) * np.cos(ground[:, 1] / 20)
    return true, rotations, ground


def _is_right(result: Alignment, turn: Positions, scale: float, places: Positions, true: Positions) -> bool:
    angle = Rotation.from_matrix(result.similarity.rotation @ turn).magnitude()
    size = np.linalg.norm([*np.ptp(true[:, :2], axis=0), HEIGHT])
    away = np.linalg.norm((result.similarity(places) - true)[:, :2], axis=1)
    return bool(
        np.degrees(angle) < 30 and abs(result.similarity.scale / scale - 1) < 0.05 and np.median(away) < 0.1 * size
    )
