"""Each partition method: where it cuts, and which views it assigns to which block."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import softmax

from clsplat.camera import Camera
from clsplat.covisibility import clusters
from clsplat.gaussians import Gaussians
from clsplat.partition import make
from clsplat.partition.make import _filled, choose_grid
from clsplat.partition.region import Space
from tests.data.fields import SIDES, cut, field, world
from tests.data.gaussians_at import gaussians_at


def test_a_view_spread_over_many_blocks_is_dropped():
    scene = field(cameras=40)
    high = scene.views[0].camera  # from high above it sees a bit of everything
    rotation = np.diag([1.0, -1, -1])
    rows = scene.observations[scene.observations[:, 1] > 0]
    seen = np.column_stack([np.arange(0, len(scene.points), 40), np.zeros(75)])
    scene = replace(
        scene,
        observations=np.concatenate([rows, seen.astype(np.int32)]),
        views=(
            replace(scene.views[0], camera=replace(high, rotation=rotation, translation=np.array([0, 0, 200.0]))),
            *scene.views[1:],
        ),
    )
    partition = cut(scene, "blockgs", (4, 4))
    assert partition.dropped == {0: "it shows too little of every block"}
    assert not any(0 in views for views in partition.views)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("count", [5, 16])
def test_blocks_of_blockgs_hold_about_the_same_with_their_margins(count, monkeypatch):
    """Also where only some of the content is looked at; margins alone would make them differ."""
    scene = field()
    rng = np.random.default_rng(0)
    far = np.linalg.norm(scene.points[:, :2] - [15, 5], axis=1)
    around = scene.points[rng.choice(len(scene.points), 20_000, p=softmax(-far / 6))]
    gaussians = Gaussians.from_points(
        around + rng.normal(0, 0.5, around.shape), np.zeros((len(around), 3), np.uint8), 0
    )

    def held(**options):
        partition = cut(scene, "blockgs", (count, 1), gaussians=gaussians, **options)
        positions = world(replace(scene, points=gaussians.positions))
        return np.array([region.reaches(positions).sum() for region in partition.regions])

    def fullest(counts):
        return counts.max() / counts.mean()

    assert fullest(held()) <= make.BALANCED
    monkeypatch.setattr(make, "MOST_SAMPLED", 10_000)
    assert fullest(held()) <= 1.05 * make.BALANCED
    monkeypatch.setattr(make, "ROUNDS", 1)
    assert fullest(held()) > 1.1


def test_blockgs_assigns_a_view_of_the_margin_to_both_sides():
    scene = field()
    lower = cut(scene, "blockgs", (2, 1), margin=0.1).regions[0]
    u = lower.space.to(scene.points)[:, 0] - lower.high[0]
    beyond = np.flatnonzero((u > 0.01) & (u < 0.08))  # of a side of about 1
    rows = scene.observations[scene.observations[:, 1] > 0]
    seen = np.column_stack([beyond, np.zeros(len(beyond), int)])
    scene = replace(scene, observations=np.concatenate([rows, seen]).astype(np.int32))
    for margin, expected in ((0.1, [True, True]), (0.0, [False, True])):
        partition = cut(scene, "blockgs", (2, 1), margin=margin)
        assert [0 in views for views in partition.views] == expected


def test_citygs_divides_a_uniform_field_evenly():
    rng = np.random.default_rng(0)
    scene = field()
    points = np.column_stack([rng.uniform(-1, 1, (8000, 2)) * SIDES, rng.uniform(0, 1, 8000)])
    scene = replace(scene, points=points, observations=None)
    gaussians = gaussians_at(points)
    for n in (2, 3, 4, 5, 6):
        partition = cut(scene, "citygs", (n, 1), gaussians=gaussians)
        content = np.bincount(partition.owner(points), minlength=n) / len(points)
        assert content[[0, -1]] == pytest.approx(1 / n, rel=0.03)
        assert content.min() > 0.7 / n and content.max() < 1.5 / n
    content = np.bincount(cut(scene, "citygs", (3, 3), gaussians=gaussians).owner(points))
    assert content.max() < 1.6 * content.min()


def test_citygs_assigns_a_view_to_the_cell_of_its_camera_and_to_cells_it_shows(monkeypatch):
    monkeypatch.setattr(clusters, "CLUSTER", 1)  # nothing is compared by chance
    scene = field(tracks=False)
    gaussians = gaussians_at(scene.points)
    calls = []

    def drop(tests):
        for view, keep in tests:
            calls.append((view, keep))
            yield 0.3 if view % 3 == 0 else 0.001

    training = np.arange(1, 60)
    partition = cut(scene, "citygs", gaussians=gaussians, drop=drop, views=training)
    home = partition.owner([v.camera.position for v in scene.views])
    rendered = {}
    for view, keep in calls:
        assert 0 < (~keep).sum() < len(keep)
        rendered.setdefault(view, []).append(keep)
    assert [view for view, _ in calls] == sorted(view for view, _ in calls)  # one full render each
    assert set(rendered) <= set(training.tolist())
    own = partition.owner(scene.points)
    for view in training:
        found = {b for b, views in enumerate(partition.views) if view in views}
        left_out = {int(np.bincount(own[~keep]).argmax()) for keep in rendered.get(int(view), [])}
        assert all((~keep[own == np.bincount(own[~keep]).argmax()]).all() for keep in rendered.get(int(view), []))
        pixels, depths = scene.views[view].camera.project(scene.points)
        size = np.array([scene.views[view].camera.width, scene.views[view].camera.height])
        shown = (depths > 0) & (abs(pixels - size / 2) < 0.6 * size).all(axis=1)
        assert left_out == {*own[shown].tolist()} - {home[view]}
        assert found == {int(home[view])} | (left_out if view % 3 == 0 else set())
    assert any(len(keeps) > 1 for keeps in rendered.values())


@pytest.mark.parametrize("grid", [(2, 2), (4, 3)])
@pytest.mark.parametrize("seed", range(2))
def test_vastgs_divides_cameras_evenly(grid, seed):
    scene = field(seed)
    owner = cut(scene, "vastgs", grid).owner([view.camera.position for view in scene.views])
    cameras = np.bincount(owner)
    assert len(cameras) == grid[0] * grid[1] and np.ptp(cameras) <= 2


@pytest.mark.parametrize(
    "box, share",
    [
        (((-1, -1, 0), (0, 1, 0)), 0.125),  # 4 x 4 of the ground are in the image from a height of 2
        (((0, 0, 0), (9, 9, 1)), 0.25),
        (((0, -9, 0), (1, 9, 1)), 0.5),  # from the height of 1 its top fills 1 of 2
        (((-9, -9, -9), (9, 9, 9)), 1),  # around the camera
        (((-9, -9, 3), (9, 9, 4)), 0),
    ],
)  # behind it
def test_vastgs_measures_the_share_of_an_image(box, share):
    above = np.array([0.0, 0, 2])
    camera = Camera(60, 60, (30.0, 30.0), (30.0, 30.0), np.diag([1.0, -1, -1]), above)
    space = Space(np.eye(3), np.zeros(3), np.ones(3))
    assert _filled(camera, above, space, np.array([box], float)) == pytest.approx(share, abs=0.01)


def test_vastgs_assigns_views_by_what_they_show():
    scene = field(cameras=60)
    partition = cut(scene, "vastgs", (2, 1))
    positions = np.array([view.camera.position for view in scene.views])
    away = np.abs(partition.space.to(positions)[:, 0] - partition.regions[0].high[0])
    over = 0
    for region, views in zip(partition.regions, partition.views):
        stands, taken = region.reaches(positions), np.isin(np.arange(60), views)
        assert taken[stands].all() and not taken[~stands & (away > 0.7)].any()
        over += (taken & ~stands).sum()
    assert over  # tilted ones look over the border


@pytest.mark.parametrize(
    "needed, aspect, grid",
    [
        (1, 1, (1, 1)),
        (2, 4, (2, 1)),
        (2, 0.2, (1, 2)),
        (4, 1, (2, 2)),
        (9, 1, (3, 3)),
        (8, 2, (4, 2)),
        (3600, 1, (60, 60)),
        (6, 1.5, (3, 2)),
        (7, 1, (3, 3)),
    ],
)
def test_the_grid_follows_need_and_aspect(needed, aspect, grid):
    assert choose_grid(needed, aspect) in (grid, grid[::-1] if aspect == 1 else grid)
