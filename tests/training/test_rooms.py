"""The room of frames, from what views were seen to need."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.rendering.pipeline import Room
from clsplat.training.rooms import MARGIN, Rooms

ROWS, SIZE = {"positions": np.zeros((1000, 3))}, (64, 48)


def rooms_of(limit=10**6):
    """Rooms of cameras that are what they see: (visible gaussians, pairs of each tile)."""
    return Rooms(SimpleNamespace(measure=lambda rows, camera, width, height: camera,
                                 most_pairs=lambda width, height, with_depth: limit))


def room_of(rooms, visible, tiles, size=SIZE):
    return rooms.room(ROWS, (visible, np.array(tiles)), *size, False)


def test_the_first_view_of_a_size_decides_until_more_is_needed():
    rooms = rooms_of()
    first = room_of(rooms, 100, [50, 30])
    assert first == Room(int(MARGIN * 100), int(MARGIN * 80) + 2)
    assert room_of(rooms, 500, [900, 900]) is first  # a frame that has no room fails
    rooms.enlarge(ROWS, (500, np.array([10, 40])), *SIZE, False)
    assert room_of(rooms, 1, [1, 1]) == Room(int(MARGIN * 500), int(MARGIN * 80) + 2)


def test_a_smaller_size_is_not_measured_and_a_larger_one_is():
    rooms = rooms_of()
    room_of(rooms, 100, [50, 30])
    assert room_of(rooms, 500, [900], (48, 63)) == Room(int(MARGIN * 100), int(MARGIN * 80))
    assert room_of(rooms, 500, [900], (49, 64)) == Room(int(MARGIN * 500), int(MARGIN * 900) + 1)
    assert room_of(rooms, 1, [1], (49, 63)) == Room(int(MARGIN * 500), int(MARGIN * 900))
    small = rooms_of(1000)
    small.forget(100, 1001)  # a frame that may need bands is measured
    assert room_of(small, 10, [1, 1]).bands == (range(0, 2),)


def test_what_is_expected_counts_as_seen():
    rooms = rooms_of()
    room_of(rooms, 700, [900])
    rooms.forget(200.4, 1000.4)
    assert room_of(rooms, 100, [80]) == Room(
        pytest.approx(MARGIN * 201, abs=1), pytest.approx(MARGIN * 1001 + 1, abs=1))
    rooms.forget()
    assert room_of(rooms, 100, [80]) == Room(140, 113)


def test_no_more_room_than_gaussians_and_than_the_limit():
    assert room_of(rooms_of(100), 900, [60, 30]) == Room(1000, 100)
    banded = room_of(rooms_of(100), 900, [60, 70, 20, 90])
    assert banded.bands == (range(0, 1), range(1, 3), range(3, 4)) and banded.pairs == 100
