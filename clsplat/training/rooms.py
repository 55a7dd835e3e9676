"""The room that the arrays of training frames have, from what views were seen to need."""

import math

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array
from clsplat.rendering.bands import choose_bands
from clsplat.rendering.pipeline import Bands, Renderer, Room
from clsplat.rendering.project import Rows

MARGIN = 1.4  # of room over the most that was seen, as views differ


class Rooms:
    """Chooses a Room for each image size.

    Parameters
    ----------
    renderer : of the frames.
    """

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self._rooms: dict[tuple[int, int], Room] = {}
        self._most_visible = self._expected_pairs = 0
        self._most_pairs: dict[tuple[int, int], int] = {}
        self._most_tiles: dict[tuple[int, int], NDArray[np.int64]] = {}  # of each tile, any view

    def forget(self, most_visible: float = 0, most_pairs: float = 0) -> None:
        """Choose anew from now on.

        Parameters
        ----------
        most_visible, most_pairs : what frames of any size are expected to need.
        """
        self._rooms.clear()
        self._most_tiles.clear()
        self._most_pairs.clear()
        self._most_visible = math.ceil(most_visible)
        self._expected_pairs = math.ceil(most_pairs)

    def room(self, rows: Rows, camera: Array, width: int, height: int, with_depth: bool) -> Room:
        """The room of a frame.

        One that is the first of its size is measured, which waits, unless frames of at least its
        size were: the windows of a block have as many sizes as it has photos.
        """
        size = width, height
        if size not in self._rooms:
            pairs = max([self._expected_pairs, *(
                most for known, most in self._most_pairs.items()
                if math.prod(known) >= math.prod(size))])
            limit = self.renderer.most_pairs(width, height, with_depth)
            if 0 < pairs <= limit:
                self._rooms[size] = Room(visible_room(self._most_visible, len(rows["positions"])),
                                         pairs_room(pairs, 0, limit))
            else:
                self.enlarge(rows, camera, width, height, with_depth)
        return self._rooms[size]

    def enlarge(self, rows: Rows, camera: Array, width: int, height: int, with_depth: bool) -> None:
        """Make room for a frame and all that were measured before."""
        size, count = (width, height), len(rows["positions"])
        visible, tiles = self.renderer.measure(rows, camera, width, height)
        most = self._most_tiles[size] = np.maximum(tiles, self._most_tiles.get(size, tiles))
        self._most_visible = max(self._most_visible, visible)
        self._most_pairs[size] = max(self._most_pairs.get(size, self._expected_pairs),
                                     int(tiles.sum()))
        limit = self.renderer.most_pairs(width, height, with_depth)
        bands: Bands = (None,)
        pairs = self._most_pairs[size]
        if pairs > limit:
            bands = choose_bands(most, limit)
            pairs = max(int(most[band.start:band.stop].sum()) for band in bands if band)
        self._rooms[size] = Room(visible_room(self._most_visible, count),
                                 pairs_room(pairs, len(tiles), limit), bands)


def visible_room(most: int, count: int) -> int:
    """Room for gaussians that a view sees, of `count`, where so many were seen at most."""
    return min(count, max(1, math.ceil(MARGIN * most)))


def pairs_room(most: int, tiles: int, limit: int) -> int:
    """Room for pairs, at most `limit`, where an image of so many tiles had so many at most."""
    return max(most, min(math.ceil(MARGIN * most) + tiles, limit))
