"""Initial gaussians: on the sparse points, random, or from a PLY file of any degree."""

import numpy as np
import pytest

from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.gaussians import FIELDS, LEARNED, Gaussians
from clsplat.io.models.ply import write_ply
from clsplat.options import TrainOptions
from clsplat.scene import Scene
from clsplat.training.start.initialise import initial_gaussians

COUNT = 500


@pytest.fixture
def scene():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(COUNT, 3)) * [5, 2, 1]
    points[0] = 1e4  # an outlier, which must not spread the random ones
    return Scene("made", (), points, rng.integers(0, 256, (COUNT, 3), np.uint8), np.array([5e6, 3.0, -7e5]))


def made(degree, fields=LEARNED):
    rng = np.random.default_rng(1)
    return Gaussians({f.name: rng.normal(size=(6, *f.row_shape(degree))).astype(np.float32) for f in fields}, degree)


def test_on_the_sparse_points(scene):
    gaussians = initial_gaussians(scene, TrainOptions(sh_degree=2))
    assert gaussians.sh_degree == 2 and gaussians.sh_rest.shape == (COUNT, 8, 3)
    assert np.array_equal(gaussians.positions, scene.points.astype(np.float32))
    assert np.allclose(0.5 + SH_C0 * gaussians.sh_constant, scene.colours / 255, atol=1e-6)
    assert np.allclose(1 / (1 + np.exp(-gaussians.opacity_logits)), 0.1)
    assert not gaussians.sh_rest.any()
    assert np.ptp(gaussians.log_scales, axis=1).max() == 0


def test_neighbours_of_a_coarse_run_lie_together(scene):
    """The same gaussians, in an order in which the next one is near."""
    as_given, ordered = (initial_gaussians(scene, TrainOptions(sh_degree=1, coarse=coarse)) for coarse in (False, True))
    steps = [np.median(np.linalg.norm(np.diff(each.positions, axis=0), axis=1)) for each in (as_given, ordered)]
    assert steps[1] < steps[0] / 4
    places = [np.lexsort(each.positions.T) for each in (as_given, ordered)]
    for name, rows in as_given.rows.items():
        assert np.array_equal(rows[places[0]], ordered.rows[name][places[1]])


def test_random(scene):
    first, again, other = (initial_gaussians(scene, TrainOptions(init="random", seed=seed)) for seed in (3, 3, 4))
    assert first.count == COUNT
    low, high = np.percentile(scene.points, (1, 99), axis=0)
    assert (first.positions >= low - 1e-5).all() and (first.positions <= high + 1e-5).all()
    assert (np.ptp(first.positions, axis=0) > 0.9 * (high - low)).all()
    assert np.array_equal(first.positions, again.positions)
    assert np.array_equal(first.sh_constant, again.sh_constant)
    assert not np.array_equal(first.positions, other.positions)


@pytest.mark.parametrize("stored, wanted", [(3, 3), (3, 1), (1, 3), (0, 2), (2, 0)])
def test_from_a_file(scene, tmp_path, stored, wanted):
    """Of another scene's offset: world coordinates are what they share."""
    path, given = tmp_path / "a.ply", made(stored)
    write_ply(path, given, scene.offset + [1, 0, 0])
    gaussians = initial_gaussians(
        scene, TrainOptions(init=str(path), sh_degree=wanted, sphere=False)
    )  # six are too few for spheres
    assert gaussians.sh_degree == wanted
    assert np.allclose(gaussians.positions, given.positions + np.float32([1, 0, 0]), atol=1e-6)
    for name in ("log_scales", "quaternions", "opacity_logits", "sh_constant"):
        assert np.array_equal(gaussians.rows[name], given.rows[name]), name
    shared = (min(stored, wanted) + 1) ** 2 - 1
    assert gaussians.sh_rest.shape == (6, (wanted + 1) ** 2 - 1, 3)
    assert np.array_equal(gaussians.sh_rest[:, :shared], given.sh_rest[:, :shared])
    assert not gaussians.sh_rest[:, shared:].any()


@pytest.mark.parametrize(
    "options, kept", [({"sphere": True}, True), ({}, False), ({"sphere": True, "schedule": "constant"}, False)]
)
def test_spheres_of_a_file_are_kept_where_the_training_has_spheres(scene, tmp_path, options, kept):
    path, given = tmp_path / "a.ply", made(2, FIELDS)
    write_ply(path, given, scene.offset + [1, 0, 0], sphere=True)
    gaussians = initial_gaussians(scene, TrainOptions(init=str(path), sh_degree=1, **options))
    assert list(gaussians.rows) == [f.name for f in (FIELDS if kept else LEARNED)]
    if kept:
        assert np.allclose(gaussians.anchors, given.anchors + np.float32([1, 0, 0]), atol=1e-6)
        assert np.array_equal(gaussians.max_offsets, given.max_offsets)


def test_what_cannot_begin(scene, tmp_path):
    with pytest.raises(InputError, match="nowhere.ply: no such file; --init expects"):
        initial_gaussians(scene, TrainOptions(init=str(tmp_path / "nowhere.ply")))
    with pytest.raises(InputError, match=f"--max-gaussians 499: .*{COUNT}; allow at least"):
        initial_gaussians(scene, TrainOptions(max_gaussians=COUNT - 1))
    assert initial_gaussians(scene, TrainOptions(max_gaussians=COUNT)).count == COUNT


@pytest.mark.parametrize("count", [0, 1])
def test_a_file_of_too_few_gaussians_is_blamed(scene, tmp_path, count):
    rows = {field.name: values[:count] for field, values in zip(LEARNED, made(0).rows.values())}
    write_ply(tmp_path / "few.ply", Gaussians(rows, 0))
    with pytest.raises(InputError, match=f"few.ply: has {count} gaussians.*--init"):
        initial_gaussians(scene, TrainOptions(init=str(tmp_path / "few.ply")))
