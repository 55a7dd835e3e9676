"""Matches against the reference, at counts where blocks and groups end, by lines and by a plane."""

import numpy as np
import pytest

from clsplat.sfm.match import Described, follow, nearest
from tests.reference import match as reference

COUNTS = (0, 1, 15, 16, 17, 70)
GROUP = 32
PAIRS = np.array([(a, b) for a in range(len(COUNTS)) for b in range(len(COUNTS)) if a != b])


@pytest.fixture(autouse=True)
def small_groups(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", GROUP)


def photos_of(seed=0):
    """Descriptors of the same places, in another order in each photo, with noise, and the places
    [N, 2] in each."""
    rng = np.random.default_rng(seed)
    scene = rng.gamma(0.6, 1, (max(COUNTS), 128))
    places = rng.uniform(-1, 1, (max(COUNTS), 2))
    photos, points = [], []
    for count in COUNTS:
        rows = rng.permutation(len(scene))[:count]
        values = np.abs(scene[rows] + rng.normal(0, 0.1, (count, 128)))
        photos.append(
            np.minimum(512 * np.sqrt(values / np.maximum(values.sum(1, keepdims=True), 1e-9)), 255)
            .round()
            .astype(np.uint8)
        )
        points.append(places[rows] + rng.normal(0, 0.01, (count, 2)))
    return photos, points


@pytest.mark.oclgrind
def test_the_nearest_of_all(device):
    photos, _ = photos_of()
    found = nearest(Described.of(device, photos), PAIRS, max(COUNTS))
    for (a, b), matches in zip(PAIRS, found):
        wanted = reference.matches(reference.nearest(photos[a], photos[b]), reference.nearest(photos[b], photos[a]))
        assert np.array_equal(matches, wanted), (a, b)
    assert max(map(len, found)) > 10


def test_only_the_first_features_are_compared(device):
    photos, _ = photos_of(1)
    (found,) = nearest(Described.of(device, photos), np.array([[5, 4]]), 32)
    wanted = reference.matches(
        reference.nearest(photos[5][:32], photos[4]), reference.nearest(photos[4], photos[5][:32])
    )
    assert np.array_equal(found, wanted) and len(found)


def test_of_equal_features_none_is_the_nearest(device):
    photos, _ = photos_of(2)
    twice = np.concatenate([photos[5], photos[5]])
    (found,) = nearest(Described.of(device, [photos[5], twice]), np.array([[0, 1]]), 200)
    assert not len(found)
    (found,) = nearest(Described.of(device, [photos[5], photos[5]]), np.array([[0, 1]]), 200)
    assert np.array_equal(found, np.repeat(np.arange(70)[:, None], 2, 1))


@pytest.mark.oclgrind
@pytest.mark.parametrize("is_plane", [True, False])
def test_where_the_geometry_allows(device, is_plane):
    photos, points = photos_of(3)
    shift = np.array([0.02, -0.05])
    # a plane that moves by `shift`, or a camera that moved to the right: lines are rows
    matrix = (
        np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0.03, -0.02, 1]])
        if is_plane
        else np.array([[0, 0, 0], [0, 0, -1], [0, 1, shift[1]]])
    )
    back = np.linalg.inv(matrix) if is_plane else matrix.T
    most = 0.057
    described = Described.of(device, photos)
    places = np.zeros((len(photos), 2, described.descriptors.shape[1]))
    for place, own in zip(places, points):
        place[:, : len(own)] = own.T
    geometry = np.array([[[*way.ravel(), is_plane, most]] * len(PAIRS) for way in (matrix, back)])
    found = follow(described, device.upload(places), PAIRS, geometry)
    for (a, b), matches in zip(PAIRS, found):
        ways = [
            reference.follow(
                photos[one],
                photos[other],
                np.column_stack([points[one], np.ones(len(points[one]))]) @ way.T,
                (points[other], is_plane, most),
            )
            for one, other, way in ((a, b, matrix), (b, a, back))
        ]
        assert np.array_equal(matches, reference.matches(*ways, 0.65)), (a, b)
    everywhere = sum(map(len, nearest(described, PAIRS, max(COUNTS))))
    assert everywhere > 1.2 * sum(map(len, found)) > 60
