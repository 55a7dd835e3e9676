"""Matches of two views of a known scene, beyond the largest features; of unrelated photos none."""

import numpy as np
import pycolmap
import pytest
import scipy

from clsplat.errors import InputError
from clsplat.sfm import two_views
from clsplat.sfm.features import create_database, image_id
from clsplat.sfm.photos import cameras_of
from clsplat.sfm.two_views import match_pairs
from tests.sfm.cases import Lines, source, unit_descriptors

COUNT, FEW = 400, 100
FLAT = 360  # of the points, in a plane; 10 pixels from where it takes them lie the others
SIZE, FOCAL = (640, 480), 500.0  # without it, 768 are guessed
TURN = scipy.spatial.transform.Rotation.from_euler("yz", (7, 20), degrees=True).as_matrix()
PAIRS = np.array([[0, 1], [0, 2], [1, 2]])


def database_of(path, is_flat=False, focal=FOCAL):
    """A database of two photos of the same points, whose features are in another order, and of a
    third of something else; and which feature of the second shows each of the first."""
    rng = np.random.default_rng(0)
    known = dict(focal_pixels=focal) if focal else {}
    photos = [source(f"{index}.jpg", *SIZE, **known) for index in range(3)]
    create_database(path, cameras_of(photos, "SIMPLE_PINHOLE"))
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 4 if is_flat else 7), (COUNT, 3))
    if is_flat:
        points[FLAT:, 2] += 0.6
    kinds, order = unit_descriptors(rng, COUNT), rng.permutation(COUNT)
    with pycolmap.Database.open(path) as database:
        for index, (shown, seen) in enumerate(
            (
                (points, kinds),
                ((points - (0.6, 0.1, 0))[order] @ TURN, kinds[order]),
                (points[::-1], unit_descriptors(rng, COUNT)),
            )
        ):
            pixels = shown[:, :2] / shown[:, 2:] * FOCAL + np.divide(SIZE, 2)
            keypoints = np.zeros((COUNT, 4), np.float32)
            keypoints[:, :2] = pixels + rng.normal(0, 0.3, pixels.shape)
            described = pycolmap.FeatureDescriptors()
            noise = np.random.default_rng(index).normal(0, 6, seen.shape)
            described.data = np.clip(seen + noise, 0, 255).round().astype(np.uint8)
            database.write_keypoints(image_id(index), keypoints)
            database.write_descriptors(image_id(index), described)
    return np.argsort(order)


def found(path, first, second):
    with pycolmap.Database.open(path) as database:
        ids = image_id(first), image_id(second)
        return database.read_two_view_geometry(*ids).inlier_matches, database.read_matches(*ids)


@pytest.mark.parametrize(
    "is_flat, focal, few", [(False, FOCAL, FEW), (False, None, FEW), (True, None, FEW), (True, None, COUNT)]
)
def test_all_features_are_matched_by_the_geometry_of_the_largest(
    tmp_path, item_device, monkeypatch, is_flat, focal, few
):
    """Also those away from a plane, if enough of the largest show how the cameras moved."""
    monkeypatch.setattr(two_views, "FEW", few)
    monkeypatch.setattr(two_views, "MANY", few)
    path, progress = tmp_path / "d.db", Lines()
    partner = database_of(path, is_flat, focal)
    match_pairs(path, PAIRS, item_device, progress)
    matches, written = found(path, 0, 1)
    assert np.array_equal(matches, written)
    count = FLAT if is_flat and few == FEW else COUNT
    assert len(matches) > 0.97 * count and (matches[:, 0] < count).all()
    assert (partner[matches[:, 0]] == matches[:, 1]).mean() > 0.99
    assert not len(found(path, 0, 2)[0]) and not len(found(path, 1, 2)[1])
    assert progress.counts == [("matching pair", 0, 3), ("matching pair", 3, 3)]


def test_more_features_are_compared_where_few_do_not_suffice(tmp_path, item_device, monkeypatch):
    """The first 40 of both photos have about four places in common."""
    path = tmp_path / "d.db"
    database_of(path)
    monkeypatch.setattr(two_views, "FEW", 64)
    monkeypatch.setattr(two_views, "FEWEST_MATCHES", 99)
    match_pairs(path, PAIRS[:1], item_device, Lines())
    assert not len(found(path, 0, 1)[0])
    with pycolmap.Database.open(path) as database:
        database.delete_two_view_geometry(1, 2)
        database.delete_matches(1, 2)
    monkeypatch.setattr(two_views, "FEWEST_MATCHES", 3)
    match_pairs(path, PAIRS[:1], item_device, Lines())
    assert len(found(path, 0, 1)[0]) > 0.97 * COUNT


def test_what_is_matched_is_not_matched_again_and_a_full_disk_is_named(tmp_path, item_device, monkeypatch):
    path = tmp_path / "d.db"
    database_of(path)
    match_pairs(path, PAIRS[:2], item_device, Lines())
    done = []
    monkeypatch.setattr(
        two_views,
        "_matched",
        lambda device, photos, pairs, pool: done.append(len(pairs)) or [pycolmap.TwoViewGeometry() for _ in pairs],
    )
    match_pairs(path, PAIRS, item_device, Lines())
    assert done == [1]
    monkeypatch.setattr(two_views, "LEAST_FREE_BYTES", 1 << 80)
    match_pairs(path, PAIRS, item_device, Lines())
    with pycolmap.Database.open(path) as database:
        database.clear_two_view_geometries()
    with pytest.raises(InputError, match="the disk is nearly full"):
        match_pairs(path, PAIRS, item_device, Lines())


def test_an_essential_matrix_of_guessed_focal_lengths_is_not_used(tmp_path):
    """pycolmap gives one, too, where the fundamental matrix is the one to use."""
    database_of(tmp_path / "d.db", focal=None)
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        photos = [two_views._read(database, index) for index in range(2)]
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    geometry.E, geometry.F = np.diag([1.0, 2, 3]), np.diag([4.0, 5, 6])
    inner = photos[0].camera.calibration_matrix()
    (there, back), by_f = two_views._allowed(geometry, *photos), inner.T @ geometry.F @ inner
    assert np.allclose(there[:9], by_f.ravel()) and np.allclose(back[:9], by_f.T.ravel())
    for photo in photos:
        photo.camera.has_prior_focal_length = True
    assert np.allclose(two_views._allowed(geometry, *photos)[0, :9], geometry.E.ravel())
