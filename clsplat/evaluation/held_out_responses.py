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
        return (
            f"{self.weight:.0%} interpolated between the training photos before and after, "
            f"{1 - self.weight:.0%} their mean"
        )


def predicted_responses(views: Iterable[View], learned: Mapping[str, Response] | None) -> Predicted | None:
    """The responses of all views of a scene from those of training views by name; None where the
    training learned none."""
    ordered = sorted(views, key=lambda view: _in_order(view.name))
    known = [place for place, view in enumerate(ordered) if view.name in (learned or {})]
    if not learned or not known:
        return None
    transforms = np.array([learned[ordered[place].name].transform for place in known])
    mean, weight = transforms.mean(axis=0), _weight(np.array(known), transforms)
    between = _interpolated(np.arange(len(ordered)), np.array(known), transforms)
    lenses = {lens_kind(ordered[place].camera): learned[ordered[place].name] for place in known}
    responses = {
        view.name: replace(lenses.get(lens_kind(view.camera), Response()), transform=mean + weight * (transform - mean))
        for view, transform in zip(ordered, between)
    }
    return Predicted({**responses, **learned}, weight)


def _weight(places: NDArray[np.integer], transforms: NDArray[np.float64]) -> float:
    """The share of the interpolation that predicts each training photo best from the others, by
    least squares: its place is as far from its neighbours as that of a held-out photo."""
    count = len(places)
    if count < FEWEST_PHOTOS:
        return 0.0
    means = (transforms.sum(axis=0) - transforms) / (count - 1)
    away = (
        np.array(
            [
                _interpolated(place, np.delete(places, index), np.delete(transforms, index, 0))
                for index, place in enumerate(places)
            ]
        )
        - means
    )
    square = float(np.vdot(away, away))
    if square <= ROUNDING * count:
        return 0.0
    return min(1.0, max(0.0, float(np.vdot(away, transforms - means)) / square))


def _interpolated(
    at: NDArray[np.integer], places: NDArray[np.integer], transforms: NDArray[np.float64]
) -> NDArray[np.float64]:
    """float64[..., 3, 4], linear between the neighbours; that of the nearest at the ends."""
    columns = transforms.reshape(len(transforms), -1).T
    return np.stack([np.interp(at, places, column) for column in columns], axis=-1).reshape(*np.shape(at), 3, 4)


def _in_order(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts photo_9 before photo_10, as cameras number them in time."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name)]
