"""Partitions: what holds for every method, and records and options that are not valid."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.errors import InputError
from clsplat.partition.options import METHODS, PartitionOptions
from clsplat.partition.region import DAMAGED, Partition
from tests.data.fields import cut, field, moved, world
from tests.data.gaussians_at import gaussians_at
from tests.refusals import refused

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
EACH_METHOD = pytest.mark.parametrize("method", METHODS)


def same(a, b):
    return len(a.views) == len(b.views) and all(map(np.array_equal, a.views, b.views))


@EACH_METHOD
@pytest.mark.parametrize("seed", range(2))
def test_every_place_has_one_owner(method, seed):
    rng = np.random.default_rng(seed)
    scene = field(seed, cameras=30, points=900)
    partition = cut(scene, method, tuple(rng.integers(1, 5, 2).tolist()))
    space = partition.space
    borders = [np.where(np.isinf(end), 0.5, end) for region in partition.regions for end in (region.low, region.high)]
    points = np.concatenate(
        [
            world(scene),
            rng.normal(0, 10.0 ** rng.uniform(-2, 12, (2000, 1)), (2000, 3)),
            space.world(np.concatenate([borders, rng.permutation(borders, axis=1)])),
        ]
    )
    owns = np.array([region.owns(points) for region in partition.regions])
    assert (owns.sum(axis=0) == 1).all()
    assert np.array_equal(owns.argmax(axis=0), partition.owner(points))


@pytest.mark.one_in(2)
@EACH_METHOD
@pytest.mark.parametrize("tracks", [True, False])
def test_a_moved_scene_is_cut_the_same(method, tracks):
    for seed in range(3):
        scene = field(seed, points=1500, cameras=40, tracks=tracks)
        turn = Rotation.random(random_state=seed).as_matrix()
        other = moved(scene, turn, 10.0 ** (seed - 1), np.array([5e5, -300.0, 20.0]))
        first, second = cut(scene, method), cut(other, method)
        assert same(first, second)
        assert np.array_equal(first.owner(world(scene)), second.owner(world(other)))


@EACH_METHOD
def test_gaussians_that_are_not_finite_do_not_count(method):
    scene = field()
    positions = scene.points.astype(np.float32)
    lost = np.where(np.arange(len(positions))[:, None] % 3 == 0, np.nan, positions)
    gone, kept = (
        cut(scene, method, gaussians=gaussians_at(rows))
        for rows in (lost, positions[np.arange(len(positions)) % 3 > 0])
    )
    assert same(gone, kept) and gone.record() == kept.record()


@EACH_METHOD
def test_a_street_without_width_can_be_cut(method):
    scene = field(tracks=False)
    scene = replace(scene, points=scene.points * [1, 0, 0])
    partition = cut(scene, method, (3, 1))
    assert partition.space.half.min() >= 0.02 * partition.space.half.max()
    content = np.bincount(partition.owner(scene.points), minlength=3)
    assert len(content) == 3 and (method == "vastgs" or content.min() > 0.7 * content.mean())


@EACH_METHOD
def test_every_view_is_assigned_or_listed_as_dropped(method):
    for seed in range(3):
        scene = field(seed, points=1500, cameras=50)
        training = np.flatnonzero(np.arange(50) % 8)
        partition = cut(scene, method, (4, 3), views=training)
        taken = set(np.concatenate(partition.views).tolist())
        assert taken | set(partition.dropped) == set(training.tolist())
        assert not taken & set(partition.dropped) and all(partition.dropped.values())
        assert all(np.array_equal(v, np.unique(v)) for v in partition.views)


@EACH_METHOD
def test_a_starved_block_is_joined_to_a_neighbour(method):
    scene = field(cameras=30)
    partition = cut(scene, method, (6, 5), least_views=6, least_gaussians=150)
    content = np.bincount(partition.owner(world(scene)), minlength=len(partition.regions))
    poor = [b for b, views in enumerate(partition.views) if len(views) < 6 or content[b] < 150]
    assert 1 < len(partition.regions) < 30 and len(poor) < len(partition.regions) / 4


@pytest.mark.parametrize(
    "changes, cause",
    [({"method": "quadtree"}, "--method quadtree: expects one of citygs"), ({"grid": (0, 2)}, "--grid 0x2")],
)
def test_bad_input_is_one_line(changes, cause):
    assert refused(lambda: PartitionOptions(**{"grid": (2, 2), **changes})).startswith(cause)


def test_a_coarse_model_without_gaussians_is_refused():
    with pytest.raises(InputError, match="nothing to divide among blocks"):
        cut(field(), "blockgs", gaussians=gaussians_at(np.full((3, 3), np.nan)))


def test_the_chosen_grid_counts_margins():
    scene = field()
    sizes = [
        len(cut(scene, "blockgs", None, block_gaussians=100, expected=400, margin=margin).regions)
        for margin in (0.0, 0.2)
    ]
    assert sizes == [4, 8]
    assert len(cut(scene, "blockgs", None).regions) == 1
    needed = dict(block_gaussians=100, expected=400, margin=0.0)
    for least, blocks in ((2, 4), (6, 6)):  # one for each worker, or as many as are needed
        assert len(cut(scene, "blockgs", None, least_blocks=least, **needed).regions) == blocks
        assert len(cut(scene, "blockgs", None, least_blocks=least).regions) == least


@EACH_METHOD
def test_records_are_exact(method):
    partition = cut(field(), method, (3, 3))
    text = json.dumps(partition.record(), allow_nan=False)
    again = Partition.from_record(json.loads(text))
    assert again.record() == partition.record() and same(again, partition)
    points = np.random.default_rng(0).normal(0, 30, (2000, 3))
    assert np.array_equal(again.owner(points), partition.owner(points))


def damaged(change):
    record = cut(field(), "citygs").record()
    change(record)
    return record


@pytest.mark.parametrize(
    "change, cause",
    [
        (lambda r: r["regions"].pop(), "6 lists"),
        (lambda r: (r["regions"].pop(), r["views"].pop()), "gap"),
        (lambda r: r["regions"][1].update(low=r["regions"][0]["low"]), "blocks 0 and 1 overlap"),
        (lambda r: r["regions"].clear(), "0 regions"),
        (lambda r: r.pop("space"), "space"),
        (lambda r: r.update(views=[["x"]] * 6), "invalid literal"),
        (lambda r: r.update(dropped=[]), "items"),
        (lambda r: r["regions"][0].pop("low"), "low"),
    ],
)
def test_a_damaged_record_is_refused(change, cause):
    with pytest.raises(DAMAGED, match=cause):
        Partition.from_record(damaged(change))
