"""What a block starts from: which gaussians of the coarse run, and which dense ones."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.cities.choose import block_start, choose_gaussians, filled, find_sizes
from clsplat.gaussians import Gaussians
from clsplat.partition.region import Region, Space
from clsplat.scene import Scene, View

SIZE, FOCAL = (64, 48), 50.0
# along the axis of `looking`: the gaussians, where they are, and how large they are
OWN, EDGE, NEAR, BEHIND, ASIDE, REACHING, OTHER_SIDE = range(7)
PLACES = [(0, 0, 5), (0, 0, 12), (0, 0, 30), (0, 0, -20), (60, 0, 50), (60, 0, 50), (0, -60, 50)]
DEVIATIONS = [1e-5, 1e-5, 1.0, 9.0, 1.0, 11.0, 13.0]


def looking(offset):
    """A Scene of one view from the origin along z, in a frame at `offset`; and the Region that owns
    z < 10 and reaches 15, of the world."""
    camera = Camera(*SIZE, (FOCAL, FOCAL), (32.0, 24.0), np.eye(3), np.zeros(3))
    points = np.array([[0.0, 0, 4], [0, 0, 6]])
    scene = Scene("look", (View("a", camera, b""),), points, np.zeros((2, 3), np.uint8), np.full(3, offset))
    space = Space(np.eye(3), np.full(3, offset), np.full(3, 10.0))
    return scene, Region(space, low=[-np.inf, -np.inf, 0], high=[np.inf, np.inf, 1], margin=0.5)


def gaussians_at(positions, deviations):
    """Gaussians of these largest standard deviations, thin in the other directions."""
    made = Gaussians.from_points(np.array(positions, float), np.zeros((len(positions), 3)), 0)
    scales = np.log(np.array(deviations, np.float32))[:, None] - np.float32([3, 0, 5])
    return Gaussians({**made.rows, "log_scales": scales}, 0)


def started(device, given, scene, region):
    return block_start(given, choose_gaussians(device, given.positions, given.log_scales, scene, region, scene.views))


@pytest.mark.parametrize("offset", [0.0, 3e6])
def test_cut(device, offset):
    """Small ones stay where the region reaches them; behind it, those that the view shows."""
    scene, region = looking(offset)
    given = gaussians_at(PLACES, DEVIATIONS)
    result = started(device, given, scene, region)
    kept = [OWN, EDGE, NEAR, REACHING, OTHER_SIDE]
    for name, values in result.gaussians.rows.items():
        assert np.array_equal(values, given.rows[name][kept]), name
    assert result.indices.tolist() == kept
    assert asdict(replace(result, gaussians=None, indices=None)) == {
        "gaussians": None,
        "indices": None,
        "own": 1,
        "margin": 1,
        "surroundings": 3,
        "dense": 0,
    }


@pytest.mark.parametrize("offset", [0.0, 3e6])
def test_dense_gaussians_fill_the_gaps_of_what_a_block_reaches(item_device, offset):
    scene, region = looking(offset)
    start = started(item_device, gaussians_at(PLACES, DEVIATIONS), scene, region)
    # beside OWN, within the reach, at its end, beyond it
    places = [(0, 0.4, 5), (0, 0.6, 5), (3, 0, 9), (1, 0, 14.9), (1, 0, 15.1)]
    dense = gaussians_at(places, np.full(5, 0.5 * np.exp(3)))  # thinner along x: 0.5
    result = filled(start, dense, scene, region)
    assert result.dense == 3 and result.own == start.own
    for name, values in result.gaussians.rows.items():
        assert np.array_equal(values[:-3], start.gaussians.rows[name]), name
        assert np.array_equal(values[-3:], dense.rows[name][[1, 2, 3]]), name
    few = filled(start, dense, scene, region, start.gaussians.count + 2)
    assert few.dense == 2 and np.array_equal(few.gaussians.positions[:-2], start.gaussians.positions)
    assert filled(start, dense, scene, region, 1).gaussians.count == start.gaussians.count
    nothing = replace(
        start, gaussians=Gaussians({name: values[:0] for name, values in start.gaussians.rows.items()}, 0)
    )
    assert filled(nothing, dense, scene, region).dense == 4


def test_sizes_in_the_view_that_shows_them_largest(device):
    scene, region = looking(0.0)
    view = scene.views[0]
    twice = replace(view, camera=view.camera.resized(128, 96))
    given = gaussians_at(PLACES, np.array(DEVIATIONS) / 50)

    def sizes(*views):
        return find_sizes(device, given.positions, given.log_scales, scene, region, views)[1]

    once = sizes(view)
    assert once[OWN] == once[EDGE] == 1 and once[BEHIND] == once[ASIDE] == 0
    assert once[NEAR] == pytest.approx(2 * FOCAL * (1.0 / 50) / 30, rel=1e-5)
    for views in ([view, twice], [twice, view]):
        assert sizes(*views)[NEAR] == 2 * once[NEAR] and sizes(*views)[EDGE] == 1
    assert not sizes()[[NEAR, REACHING]].any() and sizes()[OWN] == 1


def test_far_gaussians_are_thinned_to_the_same_area(device):
    """Of many that a view shows as half a pixel, a quarter stays, twice as large."""
    scene, region = looking(0.0)
    count, distance = 4000, 1000.0
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-300, 300, (count, 2)), np.full(count, distance)])
    given = gaussians_at(places, np.full(count, 0.25 * distance / FOCAL))
    result = started(device, given, scene, region)
    assert result.surroundings == result.gaussians.count and result.own == result.margin == 0
    assert abs(result.surroundings - count / 4) < 4 * np.sqrt(count * 3 / 16)
    larger = result.gaussians.log_scales - given.log_scales[: result.gaussians.count]
    assert np.allclose(larger, np.log(2), atol=1e-4)
    assert np.array_equal(result.gaussians.positions, started(device, given, scene, region).gaussians.positions)
