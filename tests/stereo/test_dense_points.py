"""Dense points: of photos of a plane, and how points are merged."""

from dataclasses import replace

import numpy as np
import pytest

import clsplat.stereo.dense_points as stereo_module
from clsplat.device import Reading
from clsplat.scene import Scene, View
from clsplat.stereo.dense_points import SPARSE, Points, dense_points, merge, stereo_views
from tests.kernels.test_sweep import DEPTH, cameras_of, photo_of

SLANT = 0.1  # of the plane that `photo_of` shows
MANY = 10**6


def on_plane(points):
    """Distance of points from the plane, as a share of their depth."""
    return np.abs(points[:, 2] - SLANT * points[:, 0] - DEPTH) / points[:, 2]


@pytest.fixture(scope="module")
def scene():
    """Six views of a plane, with few sparse points."""
    views = tuple(View(f"{number}", camera, b"") for number, camera in enumerate(cameras_of(6 * [(64, 48)])))
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-3, 5, 400), rng.uniform(-3, 3, 400), np.zeros(400)])
    points[:, 2] = DEPTH + SLANT * points[:, 0]
    seen = [
        (index, number)
        for number, view in enumerate(views)
        for index in np.flatnonzero(view.camera.contains(view.camera.project(points)[0]))
    ]
    return Scene("plane", views, points, np.full((400, 3), 9, np.uint8), observations=np.array(seen, np.int32))


@pytest.fixture(scope="module")
def photos(scene):
    """Of one colour channel each: half of it, and all of it."""
    grey = [255 * photo_of(view.camera)[0] for view in scene.views]
    return [np.stack([photo / 2, photo, photo]).round().astype(np.uint8) for photo in grey]


def coloured(*given):
    """Positions and colours of `dense_points`."""
    points, _ = dense_points(*given)
    return points.positions, points.colours.round().astype(np.uint8)


@pytest.mark.one_in(2)
def test_points_lie_on_the_plane_and_have_its_colours(float_device, scene, photos):
    positions, colours = coloured(float_device, scene, scene.views, photos, MANY)
    assert len(positions) > 3 * len(scene.points)
    assert np.median(on_plane(positions)) < 0.002 and np.quantile(on_plane(positions), 0.95) < 0.02
    # the photos show what the colours say; sparse points are dark
    assert np.mean(np.abs(2.0 * colours[:, 0] - colours[:, 1]) <= 2) > 0.8
    again = coloured(float_device, scene, scene.views, photos, MANY)
    assert np.array_equal(positions, again[0]) and np.array_equal(colours, again[1])


@pytest.mark.slow
def test_photos_that_do_not_fit_the_device_together(item_device, scene, photos, monkeypatch):
    together = coloured(item_device, scene, scene.views, photos, MANY)
    done = []
    monkeypatch.setattr(stereo_module, "BATCH", 2)
    found = coloured(item_device, scene, scene.views, photos, MANY, done.append)
    assert np.array_equal(found[0], together[0]) and np.array_equal(found[1], together[1])
    assert done == [1, 2, 3, 4, 5, 6]


@pytest.mark.slow
def test_the_device_has_work_while_the_host_waits(item_device, scene, photos, monkeypatch):
    """The next sweep is launched before the host waits for one."""
    events = []

    def noted(name, call):
        def function(*given):
            events.append(name)
            return call(*given)

        return function

    monkeypatch.setattr(stereo_module, "sweep", noted("launch", stereo_module.sweep))
    monkeypatch.setattr(Reading, "values", noted("wait", Reading.values))
    dense_points(item_device, scene, scene.views, photos, MANY)
    waits = ["wait", "wait"]  # for depths and scores
    assert events[:18] == ["launch", *5 * ["launch", *waits], *waits]


def test_masked_pixels_give_no_points(item_device, scene, photos):
    masks = [np.full((1, 48, 64), 255, np.uint8) for _ in photos]
    for mask, view in zip(masks, scene.views):  # all that lies at x > 0
        _, along = photo_of(view.camera)
        y, x = np.mgrid[:48, :64] + 0.5
        rays = np.stack([(x - 32) / 40, (y - 24) / 41, np.ones(x.shape)], -1) @ view.camera.rotation
        mask[0, view.camera.position[0] + along * rays[..., 0] > 0] = 0
    masked = [np.concatenate(pair) for pair in zip(photos, masks)]
    found, _ = coloured(item_device, scene, scene.views, masked, MANY)
    assert (found[:, 0] > 0.1).sum() <= (scene.points[:, 0] > 0.1).sum()  # no more than these
    assert (found[:, 0] < 0).sum() > 2 * (scene.points[:, 0] < 0).sum()


def test_photos_that_share_nothing_leave_the_sparse_points(item_device, scene, photos):
    assert stereo_views(scene, scene.views)[0]
    alone = replace(scene, observations=scene.observations[scene.observations[:, 1] == 0])
    assert stereo_views(alone, alone.views) == 6 * [[]]
    positions, colours = coloured(item_device, alone, alone.views, photos, MANY)
    assert 0.9 * len(scene.points) < len(positions) <= len(scene.points)  # some share a cell
    assert np.allclose(on_plane(positions), 0, atol=1e-9) and (colours == 9).all()


def points_at(positions, merged=1, size=0.01):
    positions = np.asarray(positions, float)
    return Points(
        positions,
        np.broadcast_to([10.0, 20.0, 30.0], positions.shape),
        np.full(len(positions), size),
        np.full(len(positions), merged),
    )


def test_points_of_a_cell_become_their_weighted_mean():
    near = points_at([[0.002, 0.002, 0.002], [0.006, 0.002, 0.002]])
    sparse = points_at([[0.0041, 0.0021, 0.0021]], SPARSE)
    merged, _ = merge(Points.joined([near, sparse]), 1)
    mean = (near.positions.sum(axis=0) + SPARSE * sparse.positions[0]) / (2 + SPARSE)
    assert np.allclose(merged.positions, mean) and merged.merged.tolist() == [2 + SPARSE]
    assert np.allclose(merged.colours, [10, 20, 30])


def test_what_lies_beside_the_surface_is_left_out_but_sparse_points_stay():
    rng = np.random.default_rng(0)
    surface = points_at(np.column_stack([rng.uniform(0, 1, (20_000, 2)), np.zeros(20_000)]))
    beside = points_at(np.column_stack([rng.uniform(0, 1, (50, 2)), rng.uniform(0.3, 1, 50)]))
    sparse = points_at([[0.5, 0.5, 2.0]], SPARSE)
    merged, _ = merge(Points.joined([surface, beside, sparse]), 1000)
    assert 700 < len(merged.sizes) <= 1000
    assert (merged.positions[:, 2] > 0.1).sum() == 1 and merged.positions[:, 2].max() == 2


def test_near_places_get_small_cells():
    """Alike many on a near plane and on one four times as far, where pixels are as much larger."""
    rng = np.random.default_rng(0)
    unit = np.column_stack([rng.uniform(0, 1, (20_000, 2)), np.zeros(20_000)])
    both = Points.joined([points_at(unit, size=0.01), points_at(4 * unit + [0, 0, 9], size=0.04)])
    merged, _ = merge(both, 500)
    far = merged.positions[:, 2] > 5
    assert 0.8 < far.sum() / (~far).sum() < 1.25 and 350 < len(far) <= 500
    assert 4e12 > merge(points_at([[0, 0, 0], [1e12, 1, 1]]), 5)[0].positions.max() > 9e11
