"""Small photos, each decoded once for all that is decided from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.scene import View
from clsplat.training.photos import decoded, with_side

SMALL_SIDE = 256  # pixels; brightness and colours need no more


class Thumbnails:
    """Photos of at most SMALL_SIDE pixels, which are decoded when they are first asked for.

    Parameters
    ----------
    views : the training views.
    """

    def __init__(self, views: Sequence[View]) -> None:
        self.views = tuple(views)
        self._photos: dict[tuple[int, int, int], NDArray[np.uint8]] = {}

    def of(self, indices: Iterable[int]) -> tuple[tuple[View, ...], Iterator[NDArray[np.uint8]]]:
        """Some of the views, with small cameras, and their photos as `photos.decode` returns them.

        All are smaller by one factor. Photos are decoded once the first is asked for.
        """
        indices = list(indices)
        small = with_side([self.views[index] for index in indices], SMALL_SIDE)
        return small, self._read(indices, small)

    def _read(self, indices: list[int], small: tuple[View, ...]) -> Iterator[NDArray[np.uint8]]:
        keys = [(index, view.camera.width, view.camera.height)
                for index, view in zip(indices, small)]
        new = {key: view for key, view in zip(keys, small) if key not in self._photos}
        self._photos |= zip(new, decoded(new.values()))
        yield from (self._photos[key] for key in keys)

    def sampled(self, most: int) -> tuple[tuple[View, ...], Iterator[NDArray[np.uint8]]]:
        """`of` at most so many evenly spaced views."""
        return self.of(range(0, len(self.views), -(-len(self.views) // most)))
