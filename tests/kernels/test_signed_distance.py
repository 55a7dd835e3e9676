"""Signed distances of a volume: against the reference, in any order, and what does not count."""

from functools import cache

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.mesh.signed_distance import SUMS, Volume
from tests import cases
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference.signed_distance import signed_distance as reference

VOXEL, TRUNCATION, NEAR = 0.125, 0.5, 0.25
BRICKS = np.array([[0, 0, 0], [-1, 0, 0], [0, 1, -1]])
ALL = range(len(BRICKS))


def a_view(width=29, height=21, seed=0, away=0.0):
    """A camera that looks at the bricks from 9 units, and the planes of what it sees."""
    rng = np.random.default_rng(seed)
    camera = Camera.looking_at((0.5, 2, 1), (1 + away, 2, 10), up=(0, 1, 0), width=width, height=height, degrees=40)
    y, x = np.mgrid[:height, :width]
    depth = 8.5 + 0.05 * x - 0.03 * y + rng.uniform(0, 0.1, (height, width))
    depth[:, width // 2] += 1  # a silhouette
    depth[rng.random(depth.shape) < 0.03] = 0
    depth[:, 4:8], depth[:, -4:-1] = 500, 0  # whose pixels are too coarse, and none
    first = depth - rng.uniform(0, 0.6, depth.shape)
    planes = depth, first, rng.uniform(0, 0.6, depth.shape), rng.random((3, height, width))
    return camera, tuple(cases.single(plane) for plane in planes)


def added(device, views, chosen=ALL):
    """The sums [7, B, N] of views on a device."""
    volume = Volume(device, BRICKS, VOXEL, TRUNCATION)
    for camera, planes in views:
        volume.add(np.array(chosen), camera, NEAR, *(device.upload(plane) for plane in planes))
    return volume.download().reshape(SUMS, len(BRICKS), -1)


def expected(views, chosen=ALL, moved=0.0):
    """Those of the reference, with the principal points moved by so many pixels."""
    return reference(
        BRICKS,
        VOXEL,
        TRUNCATION,
        [
            (chosen, camera.rotation, camera.translation, camera.focal, np.add(camera.centre, moved), NEAR, *planes)
            for camera, planes in views
        ],
    )


def two_views(size):
    return [a_view(*size), a_view(*size, seed=1, away=0.5)]


@cache
def expected_of_two(size, moved=0.0):
    return expected(two_views(size), moved=moved)


@pytest.mark.oclgrind
@pytest.mark.parametrize("size", [(29, 21), (40, 3), (16, 2)], ids=str)
def test_sums(device, size):
    found, wanted = added(device, two_views(size)), expected_of_two(size)
    # elsewhere rounding may choose another pixel, or take a sample past a limit
    shift = 1e-9 if precision_of(device) == "double" else 1e-3
    near = [expected_of_two(size, move) for move in (shift, -shift)]
    sure = np.all([abs(each - wanted) < 100 * shift for each in near], axis=(0, 1))
    assert sure.mean() > 0.95 and (wanted[2][sure] > 0).any()
    close(found[:, sure], wanted[:, sure], precision_of(device), f"sums {size}")
    if size == (29, 21):
        assert (wanted[2][sure] == 2).any() and wanted[0][sure].min() < -0.5 < 1 < wanted[0].max()


def test_only_chosen_bricks_change_and_neighbours_share_a_layer(float_device):
    sums = added(float_device, [a_view()], (1, 0)).reshape(SUMS, len(BRICKS), 33, 33, 33)
    assert not sums[:, 2].any() and sums[2, :2].any(axis=(1, 2, 3)).all()
    assert np.array_equal(sums[:, 0, 0], sums[:, 1, -1]) and sums[2, 0, 0].any()


@pytest.mark.parametrize("plane", range(4), ids=("depth", "first", "transmittance", "image"))
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_poison_ends_in_its_pixel(float_device, plane, bad):
    camera, planes = a_view()
    sound = added(float_device, [(camera, planes)])
    planes[plane][..., 8:11, 10:13] = bad
    sums = added(float_device, [(camera, planes)])
    assert np.isfinite(sums[:3]).all() and np.isfinite(sums[6]).all()
    changed = (sums != sound).any(axis=0)
    assert 0 < changed.mean() < 0.1
    if plane < 3:
        assert not sums[2][changed].any()
    else:
        assert np.array_equal(sums[:3], sound[:3])


def test_a_photo_of_one_row_shows_nothing(float_device):
    assert not added(float_device, [a_view(9, 1)]).any()
