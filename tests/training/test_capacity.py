"""The room of frames, from what views were seen to need."""

from types import SimpleNamespace

import numpy as np

from clsplat.rendering.pipeline import Room
from clsplat.training.capacity import MARGIN, FrameCapacity

ROWS, SIZE = {"positions": np.zeros((1000, 3))}, (64, 48)


def rooms_of(limit=10**6):
    """Rooms of cameras that are what they see: (visible gaussians, pairs of each tile)."""
    return FrameCapacity(SimpleNamespace(measure=lambda rows, camera, width, height: camera,
                                 most_pairs=lambda width, height, with_depth: limit))


def enlarge(rooms, visible, tiles, size=SIZE):
    """Measure a frame, and return the room of its size."""
    rooms.grow(ROWS, (visible, np.array(tiles)), *size)
    return room_of(rooms, size)


def room_of(rooms, size=SIZE):
    assert rooms.is_known(*size, False)
    return rooms.room(1000, *size, False)


def test_there_is_room_for_the_most_of_each_frame():
    rooms = rooms_of()
    assert not rooms.is_known(*SIZE, False)
    assert enlarge(rooms, 100, [50, 30]) == Room(int(MARGIN * 100), int(MARGIN * 80) + 2)
    assert enlarge(rooms, 500, [10, 40]) == Room(int(MARGIN * 500), int(MARGIN * 80) + 2)


def test_a_smaller_size_needs_no_measurement_and_a_larger_one_does():
    rooms = rooms_of()
    enlarge(rooms, 100, [50, 30])
    assert rooms.is_known(48, 63, False) and not rooms.is_known(49, 64, False)
    small = rooms_of(1000)
    small.reset(100, 1001)
    assert not small.is_known(*SIZE, False), "a frame that may need bands is measured"
    assert enlarge(small, 10, [1, 1]).bands == (range(0, 2),)


def test_no_more_room_than_gaussians_and_than_the_limit():
    assert enlarge(rooms_of(100), 900, [60, 30]) == Room(1000, 100)
    rooms = rooms_of(100)
    banded = enlarge(rooms, 900, [60, 70, 20, 90])
    assert banded.bands == (range(0, 1), range(1, 3), range(3, 4)) and banded.pairs == 100
    assert not rooms.is_known(32, 24, False), "it may need bands, too"
    assert enlarge(rooms, 1, [40], (32, 24)) == Room(1000, int(MARGIN * 40) + 4)
    assert room_of(rooms) == banded
