"""Dense points enter with the levels: how many, where, and with what was trained."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.densify.sphere import with_spheres
from clsplat.gaussians import Gaussians
from clsplat.io.scenes.read import read_scene
from clsplat.schedule.plan import Plan
from clsplat.training.parts.entering_points import FEWEST, EnteringPoints
from tests.data.tiny_training import CITY, model_digest, records, resumed, trained

SIDE, CELL = 64, 2.0  # points along each side of a square; pixels
LEVELS = 4.0, 2.0, 1.0


def filled(spheres=True, side=SIDE):
    """A part with points of a plane, two pixels from each other, and the finest gaussians."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    points = CELL * np.column_stack([x.ravel(), y.ravel(), np.zeros(side**2)]) + 0.5
    colours = np.column_stack([x.ravel(), y.ravel(), x.ravel()]).astype(np.uint8)
    finest = Gaussians.from_points(points, colours, 1)
    if spheres:
        finest = with_spheres(finest, 8)
    part = EnteringPoints()
    first = part.fill({**finest.rows, "sizes": np.ones(side**2), "pixels": np.array([CELL])},
                      LEVELS, 1, 8)
    return part, first, finest


def test_each_level_has_a_quarter_of_the_points_of_the_next():
    part, first, finest = filled()
    assert [len(node["positions"]) for node in part.nodes] == [SIDE**2 // 16, SIDE**2 // 4, SIDE**2]
    assert first.count == SIDE**2 // 16 and first.sh_degree == 1
    for coarse, fine, parents in zip(part.nodes, part.nodes[1:], part.parents):
        for name in ("positions", "sh_constant"):  # each is the mean of four
            mean = np.stack([np.bincount(parents, column) for column in fine[name].T], axis=1) / 4
            assert np.allclose(mean, coarse[name], atol=0.01)
        assert np.allclose(coarse["log_scales"] - np.median(fine["log_scales"]), np.log(2),
                           atol=0.3)
        assert (coarse["max_offsets"] > 1.5 * np.median(fine["max_offsets"])).all()
    assert np.array_equal(part.nodes[-1]["positions"], finest.positions)


def test_few_points_enter_at_once():
    part, first, finest = filled(side=12)
    assert finest.count > FEWEST > finest.count / 4 and first.count == finest.count
    assert all(np.array_equal(parents, np.arange(144)) for parents in part.parents)


@pytest.mark.parametrize("spheres", [True, False])
def test_the_next_level_takes_over_what_was_trained(item_device, spheres):
    part, first, _ = filled(spheres)
    rng, found = np.random.default_rng(0), []
    moved = {name: values + rng.normal(size=values.shape).astype(np.float32)
             for name, values in first.rows.items()}
    step = SimpleNamespace(
        model=SimpleNamespace(catch_up=lambda: found.append("caught up"), rows={
            name: item_device.upload(values) for name, values in moved.items()}),
        replace_rows=found.append)
    session = SimpleNamespace(step=step, level=4.0)
    plan = Plan(4.0, 1, False, False, False, False, 0.0)
    assert part.before_step(session, plan) is None and found == []
    new, parents = part.nodes[1], part.parents[0]
    assert part.before_step(session, Plan(2.0, 1, False, False, False, False, 0.0)) == {
        "entered": SIDE**2 // 4}
    _, growth = found
    assert np.array_equal(growth.source, parents) and growth.kept == 0
    for name in ("positions", "sh_constant", "log_scales"):
        begin, values = growth.changes[name]
        change = (moved[name] - first.rows[name])[parents]
        assert begin == 0 and values.dtype == np.float32
        assert np.allclose(values, new[name] + change, atol=1e-5)
    assert ("max_offsets" in growth.changes) == spheres
    assert set(part.state()) and len(part.nodes) == 2
    part.before_step(SimpleNamespace(step=SimpleNamespace(
        model=SimpleNamespace(catch_up=lambda: None, rows={
            name: item_device.upload(part.nodes[0][name]) for name in part.nodes[0]}),
        replace_rows=found.append), level=2.0), Plan(1.0, 1, False, False, False, False, 0.0))
    assert part.state() == {}  # nothing is left to enter


def test_a_part_goes_on_from_its_state():
    part, _, _ = filled()
    other = EnteringPoints()
    options = SimpleNamespace(sh_degree=1, sphere_neighbours=8)
    other.load(part.state(), SimpleNamespace(
        schedule=SimpleNamespace(levels=LEVELS), options=options, level=2.0))
    assert other.levels == (2.0, 1.0) and len(other.nodes) == 2
    for own, its in zip(part.nodes[1:], other.nodes):
        assert all(np.array_equal(own[name], its[name]) for name in own)
    assert np.array_equal(part.parents[1], other.parents[0])
    other = EnteringPoints()
    other.load({}, None)
    assert other.state() == {} and other.before_step(None, None) is None


@pytest.mark.slow
def test_a_training_resumed_at_a_coarser_level_ends_in_the_same_bytes(item_device, tmp_path):
    """Gaussians that enter after the resume come from the checkpoint."""
    scene = read_scene(CITY)
    options = {"schedule": "sig", "init": "dense", "iterations": 60, "levels": (4.0, 2.0, 1.0),
               "downscale": 2.0, "checkpoint_every": 4}
    whole = trained(tmp_path / "whole", scene, item_device, **options)
    counts = [record["entered"] for record in records(whole, "points")]
    plan = records(whole, "plan")[0]
    assert len(counts) == 2 and plan["gaussians"] < 0.5 * counts[0] and counts[0] < 0.5 * counts[1]
    part = trained(tmp_path / "part", scene, item_device, **options, stop_at=4)
    assert not records(part, "points")
    resumed(part, scene, item_device, **options)
    assert [record["entered"] for record in records(part, "points")] == counts
    assert model_digest(part) == model_digest(whole)
