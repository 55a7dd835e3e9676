"""Dense points enter with the levels: how many, where, and with what was trained."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.io.scenes.read import read_scene
from clsplat.schedule.plan import FEWEST_ENTERING, Plan
from clsplat.schedule.sig import Sig
from clsplat.schedule.simulate import simulate
from clsplat.training.parts import entering_points
from clsplat.training.parts.entering_points import EnteringPoints
from tests.data.tiny_training import CITY, model_digest, records, resumed, trained
from tests.schedule.driven_sig import FACTS
from tests.schedule.driven_sig import options_of as sig_options

SIDE, CELL = 64, 2.0  # points along each side of a square; pixels
LEVELS = 4.0, 2.0, 1.0


def options_of(spheres):
    return SimpleNamespace(schedule="sig", sh_degree=1, sphere=spheres, sphere_neighbours=8)


def filled(spheres=True, side=SIDE):
    """A part with points of a plane, two pixels from each other, and the coarsest gaussians."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    state = {
        "positions": CELL * np.column_stack([x.ravel(), y.ravel(), np.zeros(side**2)]) + 0.5,
        "colours": np.column_stack([x.ravel(), y.ravel(), x.ravel()]).astype(np.uint8),
        "sizes": np.ones(side**2),
        "pixels": np.array([CELL]),
    }
    part = EnteringPoints()
    return part, part.fill(state, LEVELS, options_of(spheres))


def test_each_level_has_a_quarter_of_the_points_of_the_next():
    part, first = filled()
    nodes = [node.result() for node in part.nodes]
    assert [node.count for node in nodes] == [SIDE**2 // 16, SIDE**2 // 4, SIDE**2]
    assert first is nodes[0] and first.sh_degree == 1
    for coarse, fine, parents in zip(nodes, nodes[1:], part.parents):
        for name, rounding in (("positions", 1e-4), ("sh_constant", 0.03)):  # the mean of four
            mean = np.stack([np.bincount(parents, column) for column in fine.rows[name].T], 1) / 4
            assert np.allclose(mean, coarse.rows[name], atol=rounding)
        assert np.allclose(coarse.log_scales - np.median(fine.log_scales), np.log(2), atol=0.3)
        assert (coarse.max_offsets > 1.5 * np.median(fine.max_offsets)).all()
    assert part.facts(FACTS, None, (), first).count == SIDE**2


def test_nobody_waits_for_gaussians_of_a_training_that_failed(monkeypatch):
    """Whose errors are raised where they are asked for."""
    begun, ends = threading.Event(), threading.Event()

    def slow(points, options, gaussians=entering_points._gaussians):
        if len(points.sizes) == SIDE**2:
            begun.set()
            ends.wait(60)
            raise MemoryError("the finest")
        return gaussians(points, options)

    monkeypatch.setattr(entering_points, "_gaussians", slow)
    before = set(threading.enumerate())
    part, _ = filled()
    assert begun.wait(60)
    assert all(thread.daemon for thread in set(threading.enumerate()) - before)
    ends.set()
    with pytest.raises(MemoryError, match="the finest"):
        part.nodes[-1].result()


def test_few_points_enter_at_once():
    part, first = filled(side=12)
    assert first.count == 144 > FEWEST_ENTERING > 144 / 4
    assert all(np.array_equal(parents, np.arange(144)) for parents in part.parents)
    for count, expected in ((1000, [100, 250, 550, 1000]), (12, [6, 12])):  # a forecast knows
        facts = replace(FACTS, count=count, dense=True)
        segments = simulate(Sig(sig_options(max_gaussians=count), facts))
        assert sorted({segment.gaussians for segment in segments}) == expected


def session_of(rows, found):
    """What the part needs of a session whose model has these rows."""
    return SimpleNamespace(
        step=SimpleNamespace(
            model=SimpleNamespace(catch_up=lambda: None, field=rows.__getitem__), replace_rows=found.append
        )
    )


def plan(level):
    return Plan(level, 1, False, False, False, False, 0.0)


@pytest.mark.parametrize("spheres", [True, False])
def test_the_next_level_takes_over_what_was_trained(spheres):
    part, first = filled(spheres)
    rng, found, new = np.random.default_rng(0), [], part.nodes[1].result().rows
    moved = {name: values + rng.normal(size=values.shape).astype(np.float32) for name, values in first.rows.items()}
    session, parents = session_of(moved, found), part.parents[0]
    assert part.before_step(session, plan(4.0)) is None and found == []
    assert part.before_step(session, plan(2.0)) == {"entered": SIDE**2 // 4}
    (growth,) = found
    assert np.array_equal(growth.source, parents) and growth.kept == 0
    for name in ("positions", "sh_constant", "log_scales"):
        begin, values = growth.changes[name]
        change = (moved[name] - first.rows[name])[parents]
        assert begin == 0 and np.allclose(values, new[name] + change, atol=1e-5)
    assert ("max_offsets" in growth.changes) == ("anchors" in growth.changes) == spheres
    assert part.state() and part.before_step(session, plan(2.0)) is None
    assert part.before_step(session_of(new, found), plan(1.0)) == {"entered": SIDE**2}
    assert part.state() == {} and not part.nodes  # nothing is left to enter, nor held
    assert part.facts(FACTS, None, (), first).count == SIDE**2


def test_a_part_goes_on_from_its_state():
    part, _ = filled()
    other = EnteringPoints()
    other.load(
        part.state(), SimpleNamespace(schedule=SimpleNamespace(levels=LEVELS), options=options_of(True), level=2.0)
    )
    assert other.levels == (2.0, 1.0) and len(other.nodes) == 2
    for own, its in zip(part.nodes[1:], other.nodes):
        assert all(np.array_equal(own.result().rows[name], its.result().rows[name]) for name in own.result().rows)
    assert np.array_equal(part.parents[1], other.parents[0])
    other = EnteringPoints()
    other.load({}, None)
    assert other.state() == {} and other.before_step(None, None) is None


@pytest.mark.slow
def test_a_training_resumed_at_a_coarser_level_ends_in_the_same_bytes(item_device, tmp_path):
    """Gaussians that enter after the resume come from the checkpoint."""
    scene = read_scene(CITY)
    options = {
        "schedule": "sig",
        "init": "dense",
        "iterations": 60,
        "levels": (4.0, 2.0, 1.0),
        "downscale": 3.0,
        "checkpoint_every": 4,
    }
    whole = trained(tmp_path / "whole", scene, item_device, **options)
    counts = [record["entered"] for record in records(whole, "points")]
    plan = records(whole, "plan")[0]
    assert len(counts) == 2 and plan["gaussians"] < 0.5 * counts[0] and counts[0] < 0.5 * counts[1]
    part = trained(tmp_path / "part", scene, item_device, **options, stop_at=4)
    assert not records(part, "points")
    resumed(part, scene, item_device, **options)
    assert [record["entered"] for record in records(part, "points")] == counts
    assert model_digest(part) == model_digest(whole)
