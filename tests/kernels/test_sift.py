"""SIFT on the device against the reference, at sizes where rows and octaves end."""

from functools import cache

import numpy as np
import pytest

from clsplat.constants import NO_ANGLE, SIFT_LEVELS
from clsplat.sfm import sift as module
from clsplat.sfm.sift import Sift, octaves_of
from tests.reference import sift as reference
from tests.sfm.cases import texture

SIZES = ((40, 36, 80, 72), (48, 37, 48, 37), (16, 64, 17, 65), (8, 8, 8, 8), (9, 30, 9, 30))
DESCRIBED = (40, 36, 80, 72)
ALL = 10_000


@cache
def expected(size, seed):
    """keypoints [N, 4], cells [N, 4] and octaves of the reference for a texture."""
    octaves = reference.scale_space(texture(size[1], size[0], seed), *size[2:])
    return *reference.keypoints(octaves), octaves


def found_keypoints(device, pixels, width, height):
    """keypoints [N, 4] and cells [N, 4] (octave, level, y, x), sorted by these."""
    octaves = octaves_of(width, height)
    levels = device.empty(octaves[-1].level(SIFT_LEVELS))
    rows, cells = Sift(device, ALL)._keypoints(levels, octaves, pixels)
    places = []
    for row, cell in zip(rows, cells.tolist()):
        octave = octaves[int(row[3])]
        rest, x = divmod(cell - octave.begin, octave.stride)
        places.append((int(row[3]), *divmod(rest, octave.height), x))
    return rows, np.array(places).reshape(-1, 4)


@pytest.mark.oclgrind
@pytest.mark.parametrize("size", SIZES)
def test_keypoints_are_those_of_the_reference(device, size):
    rows, places = found_keypoints(device, texture(size[1], size[0], 1), *size[2:])
    wanted, at, _ = expected(size, 1)
    if device.real == np.float64:
        assert np.array_equal(places, at) and np.abs(rows - wanted).max(initial=0) < 1e-8
        return
    ours, theirs = ({tuple(place): row for place, row in zip(*both)} for both in ((places, rows), (at, wanted)))
    same = ours.keys() & theirs.keys()
    assert len(same) >= 0.98 * max(len(ours), len(theirs))  # others are as weak as the limit
    assert all(np.abs(ours[place] - theirs[place]).max() < 1e-3 for place in same)


def test_descriptors_are_those_of_the_reference(device):
    keypoints, _, octaves = expected(DESCRIBED, 1)
    own, sift = octaves_of(*DESCRIBED[2:]), Sift(device, ALL)
    levels = device.empty(own[-1].level(SIFT_LEVELS))
    sift._keypoints(levels, own, texture(*DESCRIBED[1::-1], 1))
    angles, descriptors = sift._described(levels, own, keypoints)
    seconds, wrong, compared = 0, 0, 0
    for row, found, values in zip(keypoints, angles, descriptors):
        wanted = reference.orientations(octaves, row)
        if (found > NO_ANGLE).sum() != len(wanted):
            wrong += 1  # a second peak just as high as it must be
            continue
        seconds += len(wanted) == 2
        for angle, other, descriptor in zip(found, wanted, values):
            compared += 1
            if np.cos(angle - other) < 1 - 1e-6:
                wrong += 1  # two peaks of the same height
                continue
            away = np.abs(descriptor - reference.descriptor(octaves, row, float(angle)))
            assert away.max() < 0.5 + (1e-6 if device.real == np.float64 else 0.05)
    assert compared > 20 and seconds and wrong <= 0.02 * compared


def test_features_are_in_pixels_and_the_largest_first(device):
    pixels = texture(60, 80)
    keypoints, descriptors = Sift(device, ALL).features(pixels, 160, 120)
    assert descriptors.shape == (len(keypoints), 128) and len(keypoints) > 30
    assert (np.diff(keypoints[:, 2]) <= 0).all()
    assert (keypoints[:, :2] > 0).all() and (keypoints[:, :2] < (160, 120)).all()
    fewer, some = Sift(device, 20).features(pixels, 160, 120)
    assert np.array_equal(fewer, keypoints[:20]) and np.array_equal(some, descriptors[:20])


def test_there_is_room_for_more_keypoints_than_expected(device, monkeypatch):
    pixels = texture(40, 48)
    all_of_them = Sift(device, ALL).features(pixels, 48, 40)
    monkeypatch.setattr(module, "ROOM", 1000)
    again = Sift(device, ALL).features(pixels, 48, 40)
    assert len(all_of_them[0]) > 6
    assert all(np.array_equal(*both) for both in zip(all_of_them, again))


@pytest.mark.parametrize("value", [0, 130, 255])
def test_photos_without_detail_or_too_small_have_no_features(device, value):
    for size in ((40, 24), (7, 30), (1, 1)):
        keypoints, descriptors = Sift(device, ALL).features(np.full((size[1], size[0], 3), value, np.uint8), *size)
        assert keypoints.shape == (0, 4) and descriptors.shape == (0, 128)
