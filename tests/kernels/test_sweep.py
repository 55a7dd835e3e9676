"""A plane sweep over photos of a plane, against the reference, what has no depth, and which photos
confirm one."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.stereo.sweep import Compared, confirm, device_images, plane_warp, sweep
from tests.cases import POISON
from tests.reference.sweep import NO_MATCH
from tests.reference.sweep import confirm as reference_confirm
from tests.reference.sweep import sweep as reference

DEPTH = 5.0  # of a plane that faces the first camera, which is tilted a little
BETWEEN, PLANES = (1 / 7, 1 / 4), 24
SIZES = ((7, 7), (8, 7), (23, 11), (20, 33))


def cameras_of(sizes):
    """Cameras beside each other, each turned a little."""
    result = []
    for number, (width, height) in enumerate(sizes):
        turn = np.deg2rad(1.5 * number)
        rotation = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
        position = np.array([0.35, 0.2 * (-1) ** number, 0.02]) * number
        result.append(Camera(width, height, (40.0, 41.0), (width / 2, height / 2), rotation, -rotation @ position))
    return result


def photo_of(camera, slant=0.1):
    """[h, w]: waves on the plane z = DEPTH + slant x, seen by a camera, and the depths."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack(
        [(x - camera.centre[0]) / camera.focal[0], (y - camera.centre[1]) / camera.focal[1], np.ones(x.shape)], -1
    )
    rays = rays @ camera.rotation
    start = camera.position
    along = (DEPTH + slant * start[0] - start[2]) / (rays[..., 2] - slant * rays[..., 0])
    u, v, _ = np.moveaxis(start + along[..., None] * rays, -1, 0)
    waves = np.sin(7 * u + 3 * v) + np.sin(11 * v - 4 * u + 1) + np.sin(5 * u * v) + 0.3 * np.sin(23 * u - 17 * v)
    return 0.5 + 0.12 * waves, along


def an_input(sizes):
    """(photos rounded to float32, cameras)"""
    cameras = cameras_of(sizes)
    return [photo_of(camera)[0].astype(np.float32).astype(float) for camera in cameras], cameras


def run(device, photos, cameras, between=BETWEEN, planes=PLANES):
    compared = Compared.of(*device_images(device, photos), cameras, 0, range(1, len(photos)))
    found = sweep(compared, between, planes)
    return [array.download() for array in found]


def expected(photos, cameras, between=BETWEEN, planes=PLANES):
    sizes = [photo.shape[::-1] for photo in photos]
    width, height = np.max(sizes, axis=0)
    images = np.full((len(photos), height, width), np.nan)
    for image, photo in zip(images, photos):
        image[: photo.shape[0], : photo.shape[1]] = photo
    warps = np.array([plane_warp(cameras[0], camera) for camera in cameras[1:]])
    return reference(
        images, sizes, range(1, len(photos)), warps, between[0], (between[1] - between[0]) / (planes - 1), planes
    )


def agrees(device, photos, cameras, planes=PLANES):
    """The same depths and scores wherever no other plane is about as good, and in most pixels."""
    depths, scores = run(device, photos, cameras, planes=planes)
    known, wanted, ahead = expected(photos, cameras, planes=planes)
    rounding = 1e-9 if device.real == np.float64 else 1e-5  # much less than planes are apart
    equal = (np.abs(scores - wanted) < rounding) & (np.abs(depths - known) < rounding)
    assert equal[ahead > 5 * rounding].all() and equal.mean() > 0.9 and wanted.any()
    assert (scores > NO_MATCH).all()
    return depths, scores


@pytest.mark.oclgrind
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_depths_and_scores(device, size):
    photos, cameras = an_input(3 * [size])
    agrees(device, photos, cameras)


@pytest.mark.parametrize(
    "sizes, planes",
    [
        (((31, 17), (24, 20), (28, 9), (31, 20), (9, 20)), PLANES),
        (3 * ((25, 20),), 3),
        (((25, 20), (25, 20), (9, 11)), PLANES),
        (2 * ((25, 20),), PLANES),
    ],
    ids=["of different sizes", "three planes", "beyond the border", "one source"],
)
def test_other_photos_and_planes(float_device, sizes, planes):
    photos, cameras = an_input(sizes)
    _, scores = agrees(float_device, photos, cameras, planes)
    if len(sizes) == 2:  # the second best of one source is none
        assert (scores <= 1e-6).all() and (scores < 0).any()


def test_pixels_that_do_not_count_in_larger_sources(float_device):
    """The sweep steps over some of them, and the fine planes do not."""
    photos, cameras = an_input(3 * [(25, 20)])
    large = [replace(camera, width=75, height=60, focal=(120.0, 123.0), centre=(37.5, 30.0)) for camera in cameras[1:]]
    hidden = np.random.default_rng(0).random((2, 60, 75)) < 0.02
    sources = [np.where(mask, np.nan, photo_of(camera)[0].astype(np.float32)) for camera, mask in zip(large, hidden)]
    agrees(float_device, [photos[0], *sources], [cameras[0], *large])


def test_the_depth_of_a_slanted_plane_is_found(float_device):
    sizes = 4 * [(64, 48)]
    photos, cameras = an_input(sizes)
    true = photo_of(cameras[0])[1]
    brighter = [photos[0], 0.6 * photos[1] + 0.2, *photos[2:]]
    for each in (photos, brighter):
        depths, scores = run(float_device, each, cameras, planes=48)
        good = scores > 0.5
        assert good.mean() > 0.7
        error = np.abs(depths[good] * true[good] - 1)
        assert np.median(error) < 0.002 and np.quantile(error, 0.95) < 0.02


def test_what_has_no_depth(float_device):
    photos, cameras = an_input(3 * [(25, 20)])
    depths, _ = run(float_device, photos, cameras)
    inner = np.zeros((20, 25), bool)
    inner[3:-3, 3:-3] = True
    assert not depths[~inner].any() and depths[inner].any()
    ahead = [
        cameras[0],
        *(replace(camera, translation=camera.translation - [0, 0, 20]) for camera in cameras[1:]),
    ]  # the planes are behind them
    assert not run(float_device, photos, ahead)[0].any()
    photos_of_plane, four = an_input(4 * [(64, 48)])
    for between in ((1 / 4.5, 1 / 3), (1 / 9, 1 / 6)):  # the plane lies beyond them
        beyond, scores = run(float_device, photos_of_plane, four, between)
        assert (beyond == 0).mean() > 0.95 and (scores > 0.5).mean() < 0.01
    flat = [np.full((20, 25), 0.5), *photos[1:]]
    assert not run(float_device, flat, cameras)[0].any()
    masked = [photos[0].copy(), *photos[1:]]
    masked[0][10, 12] = np.nan
    hidden, _ = run(float_device, masked, cameras)
    assert not hidden[7:14, 9:16].any() and np.array_equal(hidden[:, 17:], depths[:, 17:])
    masked = [photos[0], np.full((20, 25), np.nan), photos[2]]
    assert (run(float_device, masked, cameras)[1] <= 1e-6).all()  # one source is left


def poison(images, cameras, place, bad):
    """Put a bad value into a pixel of an image, or into the pose of the source."""
    if place in ("own", "source"):
        images[int(place == "source")][8, 11] = POISON[bad]
    else:
        name = "rotation" if place == "turned" else "translation"
        getattr(cameras[1], name)[..., 0] = POISON[bad]


@pytest.mark.parametrize("bad", POISON)
@pytest.mark.parametrize("place", ["own", "source", "turned", "shifted"])
@pytest.mark.one_in(3)
def test_poison_ends_where_it_is(float_device, place, bad):
    photos, cameras = an_input(3 * [(25, 20)])
    poison(photos, cameras, place, bad)
    with np.errstate(all="ignore"):
        depths, scores = run(float_device, photos, cameras)
    assert np.isfinite(depths).all() and np.isfinite(scores).all()
    assert (scores >= NO_MATCH).all() and (scores <= 1 + 1e-5).all()


SAME = 0.02


def confirmed(device, depths, cameras, sources, reference=0):
    compared = Compared.of(*device_images(device, depths), cameras, reference, sources)
    return confirm(compared, SAME).download()


@pytest.mark.oclgrind
@pytest.mark.parametrize(
    "sizes", [3 * [(9, 7)], [(23, 11), (20, 13), (15, 11), (23, 13), (9, 9)]], ids=["of one size", "of different sizes"]
)
def test_sources_confirm_depths_that_they_share(device, sizes):
    """Depths of a plane, of which some are wrong by about the difference that counts."""
    cameras, rng = cameras_of(sizes), np.random.default_rng(0)
    depths = []
    for camera in cameras:
        inverse = 1 / photo_of(camera)[1]
        inverse *= 1 + rng.choice([0, 0, 0.8, 1.2], inverse.shape) * SAME
        inverse[rng.random(inverse.shape) < 0.1] = 0
        depths.append(inverse.astype(np.float32).astype(float))
    sources = list(range(1, len(sizes)))
    counts = confirmed(device, depths, cameras, sources)
    wanted, margin = reference_confirm(depths, sizes, cameras, 0, sources, SAME)
    height, width = wanted.shape
    clear = margin > (1e-9 if device.real == np.float64 else 1e-4)
    assert np.array_equal(counts[:height, :width][clear], wanted[clear])
    assert clear.mean() > 0.9 and {0, 1, 2} <= {*wanted.ravel()}
    again = confirmed(
        device, depths[::-1], cameras[::-1], [len(sizes) - 1 - source for source in sources], len(sizes) - 1
    )
    assert np.array_equal(again, counts)


@pytest.mark.parametrize("bad", POISON)
@pytest.mark.parametrize("place", ["own", "source", "turned", "shifted"])
@pytest.mark.one_in(5)
def test_poison_confirms_nothing(float_device, place, bad):
    cameras = cameras_of(2 * [(25, 20)])
    depths = [1 / photo_of(camera)[1] for camera in cameras]
    sound = confirmed(float_device, depths, cameras, [1])
    poison(depths, cameras, place, bad)
    with np.errstate(all="ignore"):
        counts = confirmed(float_device, depths, cameras, [1])
    if place == "own":
        assert (counts != sound).sum() <= 1
    elif place == "source":
        assert (counts != sound).sum() <= 4  # pixels that project to that of the source
    elif not np.isfinite(POISON[bad]):
        assert not counts.any()
    assert counts.max() <= 1
