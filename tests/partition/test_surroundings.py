"""On which side of a block a view sees what surrounds it, and what enters the block."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.partition.region import Region, Space
from clsplat.partition.surroundings import Sides, deviations_along, enters_reach
from clsplat.scene import Scene, View

OFFSET, UNIT = np.array([3e6, -1e6, 40.0]), 2.5


def scene_of(region):
    view = View("a", Camera(8, 8, (8.0, 8.0), (4.0, 4.0), np.eye(3), np.zeros(3)), b"")
    return Scene("block", (view,), np.zeros((2, 3)), np.zeros((2, 3), np.uint8), OFFSET,
                 unit=UNIT, region=region)


def space_of(seed, contracted=False):
    """A turned space, and the local positions of coordinates of its area of interest."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    space = Space(rotation, OFFSET + rng.normal(size=3), rng.uniform(2, 9, 3), contracted)
    return space, lambda u: (space.origin + u * space.half @ rotation - OFFSET) / UNIT


def regions(seed):
    """A cell of two sides, of three and four with a margin, and one that reaches from a corner."""
    space, local = space_of(seed)
    inf = np.inf
    for low, high, margin in (([-0.2, -0.3, -inf], [0.3, 0.2, inf], 0.2),
                              ([-inf, -0.4, -inf], [0.1, 0.3, inf], 0.3),
                              ([-inf, -inf, -inf], [0.2, 0.1, inf], 0.1),
                              ([-0.3, -0.2, -0.5], [0.2, 0.4, 0.1], 0.0)):
        yield Region(space, np.array(low), np.array(high), margin), local
    half, local = space_of(seed, contracted=True)
    yield Region(half, [0.4, 0.45, 0], [0.6, 0.7, 1], 0.1), local


@pytest.mark.parametrize("seed", range(3))
def test_a_ray_meets_what_is_in_front_then_the_block_then_what_is_behind(seed):
    rng, met = np.random.default_rng(seed), np.zeros(3, int)
    for region, local in regions(seed):
        scene = scene_of(region)
        for _ in range(40):
            eye, end = local(rng.uniform(-0.95, 0.95, (2, 3)))
            places = eye + np.linspace(0, 1, 200)[1:, None] * (end - eye)
            parts = np.where(scene.reached(places), 1, 2 * Sides(scene, places).behind(eye))
            assert (np.diff(parts) >= 0).all()
            met += np.bincount(parts, minlength=3) > 0
            if scene.reached(eye[None])[0]:
                assert Sides(scene, places).behind(eye).all()
    assert (met > 20).all()


def test_where_a_ray_never_meets_the_block_the_side_of_the_camera_decides():
    space = Space(np.eye(3), OFFSET, np.full(3, 10.0))
    scene = scene_of(Region(space, [-0.1, -0.1, -np.inf], [0.1, 0.1, np.inf]))
    eye = np.array([-2.0, 0, 0])
    places = np.array([[-1, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 1, 0], [1, -1, 0]])
    assert Sides(scene, places).behind(eye).tolist() == [False, True, True, False, True]
    assert Sides(scene, places).behind([0, 0, 9]).all()


def discs(positions, scales, quaternions=None):
    made = Gaussians.from_points(np.array(positions, float), np.zeros((len(positions), 3)), 0)
    rows = {**made.rows, "log_scales": np.log(np.array(scales, np.float32))}
    if quaternions is not None:
        rows["quaternions"] = np.array(quaternions, np.float32)
    return Gaussians(rows, 0)


@pytest.mark.parametrize("contracted", [False, True])
def test_a_gaussian_enters_with_its_own_extent(contracted):
    """A thin one only if it is turned towards the block; sizes and distances are local ones."""
    space = Space(np.eye(3), OFFSET, np.full(3, 10.0), contracted)
    edge = 0.5 + 0.1 / 4 if contracted else 0.1  # one world unit from the origin: 0.4 local ones
    scene = scene_of(Region(space, high=[edge, np.inf, np.inf]))
    turned = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # a quarter about z: its x axis along y
    given = discs([[0.1, 0, 0], [0.9, 0, 0], [0.9, 0, 0], [0.9, 0, 0], [0.9, 0, 0]],
                  [[.1, .1, .1], [.6, .01, .01], [.6, .01, .01], [.01, .6, .01], [.3, .3, .3]],
                  [[1, 0, 0, 0], [1, 0, 0, 0], turned, turned, [2, 0, 0, 0]])
    assert enters_reach(scene, given, 1.0).tolist() == [True, True, False, True, False]
    assert enters_reach(scene, given, 2.0).tolist() == [True, True, False, True, True]
    assert np.allclose(deviations_along(given.quaternions, given.log_scales, np.eye(3))[:, 2],
                       [.01, .6, .01])


def test_only_a_block_has_surroundings():
    scene = replace(scene_of(None))
    with pytest.raises(ValueError, match="no surroundings"):
        Sides(scene, np.zeros((1, 3)))
