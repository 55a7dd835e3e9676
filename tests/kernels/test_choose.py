"""What a region reaches, and how large views show what it does not."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.cities.choose import find_sizes, note_outside
from clsplat.partition.region import Region, Space
from clsplat.scene import Scene, View
from tests.cases import POISON
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference import choose as reference

COUNT, NEAR_BORDER = 3000, 1e-5  # of a side: whether it is inside may round either way


def scene_at(offset, unit, views=12):
    """A scene without points; its cameras stand around and look inwards."""
    rng = np.random.default_rng(1)
    cameras = [
        Camera.looking_at(rng.normal(0, 0.2, 3), rng.normal(0, 1.5, 3), width=64, height=40, degrees=50)
        for _ in range(views)
    ]
    scene = Scene(
        "made",
        tuple(View(f"{number}", camera, b"") for number, camera in enumerate(cameras)),
        np.zeros((1, 3)),
        np.zeros((1, 3), np.uint8),
        np.full(3, offset),
    )
    return replace(scene, unit=unit)


def region_in(scene, contracted, margin=0.1, unbounded=False):
    """A region of a turned space, in the middle of gaussians that are normal about the origin."""
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    space = Space(turn, scene.offset + 0.1 * scene.unit, scene.unit * np.array([1.0, 0.7, 2.0]), contracted)
    low, high = ((0.3, 0.2, 0.1), (0.6, 0.7, 0.9)) if contracted else ((-0.5, -1.2, -np.inf), (0.4, 0.9, np.inf))
    return Region(space, margin=margin) if unbounded else Region(space, low, high, margin)


def gaussians():
    rng = np.random.default_rng(0)
    return (rng.normal(0, 0.7, (COUNT, 3)).astype(np.float32), rng.normal(-4, 1.0, (COUNT, 3)).astype(np.float32))


@pytest.mark.oclgrind
@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("offset, unit", [(0.0, 1.0), (3e6, 40.0)])
@pytest.mark.parametrize("deviations", [0.0, 2.0])
def test_what_a_region_reaches(device, contracted, offset, unit, deviations):
    scene = scene_at(offset, unit)
    region, (positions, log_scales) = region_in(scene, contracted), gaussians()
    lower, expected, higher = (
        reference.outside(scene, replace(region, margin=region.margin + change), positions, log_scales, deviations)
        for change in (-NEAR_BORDER, 0, NEAR_BORDER)
    )
    before = (np.arange(COUNT) % 7 == 0).astype(np.uint32)
    outside, sure = device.upload(before), lower == higher
    note_outside(device, scene, region, device.upload(positions), device.upload(log_scales), outside, deviations)
    wanted = (before > 0) | expected
    assert np.array_equal(outside.download()[sure] > 0, wanted[sure]) and sure.mean() > 0.99
    assert 0.1 < expected.mean() < 0.95


def test_a_spread_that_leads_out_on_one_side_is_enough(device):
    """Along u and v; what reaches beyond a cell upwards is within it."""
    scene = scene_at(0.0, 2.0)
    space = Space(np.eye(3), np.zeros(3), np.full(3, 4.0))
    region = Region(space, [-0.5, -0.5, -0.5], [0.5, 0.5, 0.5])
    inner = 0.9  # local: 0.45 in the space, which is 0.05 or 0.1 from the end
    places = np.array(
        [[inner, 0, 0], [-inner, 0, 0], [0, inner, 0], [0, -inner, 0], [0, 0, inner], [0, 0, -inner], [0, 0, 0]],
        np.float32,
    )
    for scale, expected in ((0.04, 7 * [0]), (0.06, [1, 1, 1, 1, 0, 0, 0])):
        outside = device.zeros(7, np.uint32)
        logs = np.full((7, 3), np.log(scale), np.float32) - np.float32([1, 0, 2])
        note_outside(device, scene, region, device.upload(places), device.upload(logs), outside)
        assert outside.download().tolist() == expected


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("poison", POISON)
@pytest.mark.one_in(4)
def test_a_bad_position_is_outside_and_hides_no_other(device, poison, contracted):
    scene = scene_at(0.0, 1.0)
    positions, log_scales = gaussians()
    positions[::5, 1] = POISON[poison]
    unbounded = region_in(scene, contracted, unbounded=True)
    reached, sizes = find_sizes(device, positions, log_scales, scene, unbounded, scene.views)
    good = np.isfinite(positions).all(axis=1)
    moderate = good & (np.abs(positions).max(axis=1) < 1e18)  # farther ones may overflow
    assert reached[moderate].all() and not reached[~good].any() and np.isfinite(sizes[good]).all()
    region = region_in(scene, contracted)
    again = find_sizes(device, positions, log_scales, scene, region, scene.views)
    rest = np.arange(COUNT) % 5 != 0
    alone = find_sizes(device, positions[rest], log_scales[rest], scene, region, scene.views)
    assert all(np.array_equal(one[rest], other) for one, other in zip(again, alone))


@pytest.mark.oclgrind
@pytest.mark.parametrize("views", [0, 1, 12])
def test_sizes_in_views(device, views):
    scene = scene_at(0.0, 1.0, views)
    region, (positions, log_scales) = region_in(scene, False), gaussians()
    reached, found = find_sizes(device, positions, log_scales, scene, region, scene.views)
    lower, expected, higher = (
        reference.sizes(scene, region, positions, log_scales, scene.views, reference.SHOWN_DEVIATIONS + change)
        for change in (-1e-4, 0, 1e-4)
    )
    sure = lower == higher
    assert sure.mean() > 0.99
    close(found[sure], expected[sure], precision_of(device), "sizes")
    assert (found[reached] == 1).all() and (views == 0) == (not found[~reached].any())
    assert views == 0 or 0.03 < ((found > 0) & (found < 1)).mean()


def test_nothing_before_the_near_plane_is_shown(device):
    scene = scene_at(0.0, 1.0, 1)
    camera, region = scene.views[0].camera, region_in(scene, False)
    places = [camera.position + depth * scene.near_plane * camera.rotation[2] for depth in (-2.0, 0.5, 2.0)]
    scene = replace(scene, offset=scene.offset + 100)  # far from the cell
    _, sizes = find_sizes(device, np.float32(places), np.full((3, 3), -12, np.float32), scene, region, scene.views)
    assert sizes.tolist() == [
        0,
        0,
        pytest.approx(2 * np.exp(-12) * max(camera.focal) / (2 * scene.near_plane), rel=1e-3),
    ]
