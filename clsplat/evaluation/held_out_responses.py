"""Responses of held-out photos, from those of the training photos before and after them.

A held-out photo has nothing to learn its own response from that would not be a fit to it. But
cameras change their exposure slowly, so the photos before and after it tell much of it, and where
they do not, the mean of all does. Training photos tell which it is: each is predicted from the
others, without itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.response import Response, lens_kind
from clsplat.scene import View

FEWEST_PHOTOS = 3  # from which a weight can be told
ROUNDING = 1e-16  # squared differences of transforms that are this small are rounding


@dataclass(frozen=True)
class Predicted:
    """Responses with which views are rendered for a comparison with their photos.

    Attributes
    ----------
    responses : by name; a training view has the one that it has learned.
    weight : share of the interpolation between the photos before and after in those of held-out
        views, 0 to 1; the rest is the mean of all training photos.
    """

    responses: Mapping[str, Response] = field(default_factory=dict)
    weight: float = 0.0

    def __str__(self) -> str:
        return (f"{self.weight:.0%} interpolated between the training photos before and after, "
                f"{1 - self.weight:.0%} their mean")


def predicted_responses(views: Iterable[View], learned: Mapping[str, Response] | None
                        ) -> Predicted | None:
    """The responses of all views of a scene; None where the training learned none.

    Parameters
    ----------
    views : of the scene, training views and others.
    learned : the responses of training views by name.
    """
    ordered = sorted(views, key=lambda view: _in_order(view.name))
    known = [place for place, view in enumerate(ordered) if view.name in (learned or {})]
    if not learned or not known:
        return None
    transforms = np.array([learned[ordered[place].name].transform for place in known])
    mean, places = transforms.mean(axis=0), np.array(known)
    weight = interpolation_weight(places, transforms)
    lenses = {lens_kind(ordered[place].camera): learned[ordered[place].name] for place in known}
    responses = dict(learned)
    for place, view in enumerate(ordered):
        if view.name not in learned:
            between = interpolated(place, places, transforms)
            responses[view.name] = replace(lenses.get(lens_kind(view.camera), Response()),
                                           transform=mean + weight * (between - mean))
    return Predicted(responses, weight)


def interpolation_weight(places: NDArray[np.integer], transforms: NDArray[np.float64]) -> float:
    """The share of the interpolation that predicts training photos best, by least squares.

    Each is predicted from the others: its place between its neighbours is as far from them as that
    of a held-out photo.

    Parameters
    ----------
    places : int[V], the places of the photos in the order of all, ascending.
    transforms : float64[V, 3, 4].
    """
    if len(places) < FEWEST_PHOTOS:
        return 0.0
    product = square = 0.0
    for index, place in enumerate(places):
        others = np.delete(transforms, index, axis=0)
        mean = others.mean(axis=0)
        away = interpolated(place, np.delete(places, index), others) - mean
        product += float(np.vdot(away, transforms[index] - mean))
        square += float(np.vdot(away, away))
    return min(1.0, max(0.0, product / square)) if square > ROUNDING * len(places) else 0.0


def interpolated(place: int, places: NDArray[np.integer], transforms: NDArray[np.float64]
                 ) -> NDArray[np.float64]:
    """float64[3, 4], linear between the neighbours of a place; that of the nearest at the ends."""
    after = int(np.searchsorted(places, place))
    low, high = max(after - 1, 0), min(after, len(places) - 1)
    gap = places[high] - places[low]
    share = (place - places[low]) / gap if gap else 0.0
    result: NDArray[np.float64] = transforms[low] + share * (transforms[high] - transforms[low])
    return result


def _in_order(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts photo_9 before photo_10, as cameras number them in time."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part)
            for part in re.split(r"(\d+)", name)]
