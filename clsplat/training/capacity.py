"""Capacities of the buffers of frames, chosen from the largest frames that were seen so far."""

import math

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array
from clsplat.rendering.blend import choose_bands
from clsplat.rendering.pipeline import Renderer, Room
from clsplat.rendering.project import Rows

MARGIN = 1.4  # of room over the most that was seen, as views differ


class FrameCapacity:
    """Chooses a Room for each image size. Sizes have the same room, so that their frames use the
    same memory; but for those that need bands."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self._most_visible = self._expected_pairs = 0
        self._most_pairs: dict[tuple[int, int], int] = {}  # of the sizes that were measured
        self._most_tiles: dict[tuple[int, int], NDArray[np.int64]] = {}  # of each tile, any view

    def reset(self, most_visible: float = 0, most_pairs: float = 0) -> None:
        """Choose anew from now on, by what frames of any size are expected to need."""
        self._most_tiles.clear()
        self._most_pairs.clear()
        self._most_visible = math.ceil(most_visible)
        self._expected_pairs = math.ceil(most_pairs)

    def is_known(self, width: int, height: int, with_depth: bool) -> bool:
        """Whether a room can be chosen: a frame of the size was measured, or what it needs is known
        from larger ones and does not need bands."""
        limit = self.renderer.most_pairs(width, height, with_depth)
        return (width, height) in self._most_tiles or 0 < self._needed(width, height) <= limit

    def room(self, count: int, width: int, height: int, with_depth: bool) -> Room:
        """The room of frames of a size that is known, for a model of `count` gaussians."""
        limit = self.renderer.most_pairs(width, height, with_depth)
        visible = min(count, max(1, math.ceil(MARGIN * self._most_visible)))
        if self._needed(width, height) > limit:
            most = self._most_tiles[width, height]
            bands = choose_bands(most, limit)
            pairs = max(int(most[band.start : band.stop].sum()) for band in bands if band)
            return Room(visible, _pairs_room(pairs, len(most), limit), bands)
        pairs = max(
            most for most in (self._expected_pairs, *self._most_pairs.values()) if most <= limit
        )  # sizes that need no bands have room for as many
        tiles = max(map(len, self._most_tiles.values()), default=0)
        return Room(visible, _pairs_room(pairs, tiles, limit))

    def grow(self, rows: Rows, camera: Array, width: int, height: int) -> None:
        """Make room for a frame, which is measured, and all that were measured before."""
        size = width, height
        visible, tiles = self.renderer.measure(rows, camera, width, height)
        self._most_tiles[size] = np.maximum(tiles, self._most_tiles.get(size, tiles))
        self._most_visible = max(self._most_visible, visible)
        self._most_pairs[size] = max(self._most_pairs.get(size, self._expected_pairs), int(tiles.sum()))

    def _needed(self, width: int, height: int) -> int:
        """The most pairs of a frame of the size, or where none was measured of those that are at
        least as large; 0: there is none."""
        return self._most_pairs.get(
            (width, height),
            max(
                [
                    self._expected_pairs,
                    *(most for known, most in self._most_pairs.items() if math.prod(known) >= width * height),
                ]
            ),
        )


def _pairs_room(most: int, tiles: int, limit: int) -> int:
    """Room for pairs, at most `limit`, where an image of so many tiles had so many at most."""
    return max(most, min(math.ceil(MARGIN * most) + tiles, limit))
