"""Whether measured positions place a reconstruction as it can be, and what is wrong if not.

Flat ground fits its mirror image by a half turn about a horizontal axis, so that exchanged
coordinates turn a scene upside down with a small residual. So no alignment is believed before it is
compared with the vertical that photos show, and with what the same positions would give if they
were exchanged, mirrored or had other heights.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.georeference import MOST_RESIDUAL
from clsplat.placement.alignment import LEAST_POSITIONS, Alignment, aligned
from clsplat.placement.up import Vertical

LEAST_FOR_GUESS = 5  # positions; fewer fit a mirror image by chance
TIMES_BETTER = 5.0  # so much smaller is the residual of what is probably meant
MOST_LEFT_OUT = 0.2  # of the positions
OF_UP = 3.0  # standard deviations of up by which a scene may be tilted
LINE = 0.03  # of the size: positions that are all nearer to a line fit their mirror image
LINE_MISSES = 3.0  # or nearer than so many residuals: the deviation from a line may be noise


class Guess(NamedTuple):
    """What positions may be instead: a question for the user, such as "are x and y exchanged?",
    and the positions float64[N, 3] as they are then."""

    question: str
    positions: NDArray[np.float64]


class NotGeoreferenced(InputError):
    """Why a reconstruction has no place on the earth."""


class TooFewPositions(NotGeoreferenced):
    """Nothing is wrong: the photos simply have no GPS, or hardly any."""


def believed(
    places: ArrayLike,
    positions: ArrayLike,
    vertical: Vertical,
    guesses: Sequence[Guess] = (),
    *,
    std: ArrayLike | None = None,
    is_control: bool = False,
) -> Alignment:
    """The alignment of places with positions, as `aligned` finds it.

    Parameters
    ----------
    places, positions, vertical, std : as in `aligned`.
    guesses : what is tried as well.
    is_control : whether these are ground control points, whose heights are as right as the rest.

    Raises
    ------
    NotGeoreferenced : there is none, it is upside down or tilted, or a guess fits far better.
    """

    def attempt(measured: ArrayLike) -> Alignment | None:
        return aligned(places, measured, vertical, std=std, is_control=is_control)

    def miss(found: Alignment) -> float:
        return float(np.hypot(found.horizontal, np.nan_to_num(found.vertical) * is_control))

    result = attempt(positions)
    question, least = "", np.inf
    if result is not None and result.stands:
        if len(result.used) < LEAST_FOR_GUESS:
            return result
        least = miss(result) / result.size / TIMES_BETTER
    for guess in guesses:
        other = attempt(guess.positions)
        if other is None or not other.stands or (result is not None and other.used.sum() < result.used.sum()):
            continue
        share = miss(other) / other.size
        if share <= MOST_RESIDUAL and share < least:
            least, question = share, guess.question
    if result is None:
        reason = "and the reconstruction contradict each other, or the places are too close together"
    elif not result.stands:
        reason = (
            "fit only if the scene is turned upside down or tilted by "
            f"{vertical.tilt(result.similarity.rotation):.0f} degrees"
        )
    elif question:
        reason = f"miss the reconstruction by {miss(result):.3g} m"
    else:
        return result
    subject, cure = (
        ("--gcp: the ground control points", "check the coordinates, the CRS and the marks")
        if is_control
        else ("the photos' GPS positions", "check the coordinates")
    )
    raise NotGeoreferenced(f"{subject} {reason}" + (f": {question}" if question else f"; {cure}"))


def are_priors(result: Alignment) -> bool:
    """Whether the positions of an alignment are good enough, and enough of them, to adjust to."""
    return bool(
        result.used.sum() > LEAST_POSITIONS
        and result.used.mean() >= 1 - MOST_LEFT_OUT
        and result.horizontal <= MOST_RESIDUAL * result.size
    )


def doubts(
    result: Alignment,
    positions: ArrayLike,
    vertical: Vertical,
    residuals: tuple[float, float],
    is_control: bool = False,
) -> list[str]:
    """Sentences on what a user must not rely on in an alignment.

    Parameters
    ----------
    positions, vertical : that it was made of.
    residuals : metres, along the ground and in height.
    is_control : as in `believed`.
    """
    size_of = "the surveyed area" if is_control else "the flight"
    found = [
        f"the residual of {value:.2f} m {where} is {100 * value / max(result.size, 1e-9):.0f} "
        f"% of the size of {size_of}, {result.size:.0f} m: {cure}"
        for value, where, cure in zip(
            residuals,
            ("along the ground", "in height"),
            ("place, scale and directions are uncertain", "do not rely on heights"),
        )
        if np.isfinite(value) and value > MOST_RESIDUAL * result.size
    ]
    wrong = ~result.used | (~result.used_heights if is_control else False)
    if wrong.mean() > MOST_LEFT_OUT:
        found.append(
            f"{wrong.sum()} of {len(wrong)} positions contradict the others, so the "
            "others may be the wrong ones: check them"
        )
    tilt = vertical.tilt(result.similarity.rotation)
    if tilt > OF_UP * vertical.degrees:
        found.append(f"the scene is tilted by {tilt:.0f} degrees from what its photos show as up: check the heights")
    if result.used.sum() == LEAST_POSITIONS:
        found.append(f"only {LEAST_POSITIONS} positions decide, so that an error of one of them would not be noticed")
    flat = np.asarray(positions, np.float64)[result.used, :2]
    flat = flat - flat.mean(axis=0)
    across = flat @ np.linalg.svd(flat, full_matrices=False)[2][1]
    if np.ptp(across) <= max(LINE * result.size, LINE_MISSES * result.horizontal):
        found.append(
            "the positions lie on one line, so that the tilt across it is not measured, "
            "and exchanged or mirrored coordinates would not be noticed"
        )
    return found
