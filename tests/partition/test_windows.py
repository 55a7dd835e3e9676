"""Windows of few sizes hold what they held, and each block gets its share of what photos show."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.cities.cut import visits_of_blocks
from clsplat.gaussians import Gaussians
from clsplat.partition.windows import of_few_sizes, owned_shares, seen_pixels
from clsplat.scene import View
from tests.city.test_block import region_of

AT = np.zeros(3)


def view_of(name, width, height):
    return View(name, Camera(width, height, (100.0, 100.0), (width / 2, height / 2), np.eye(3), AT), None)


def some_windows(rng, views):
    windows = {}
    for view in views[:-3]:  # the last ones are read whole
        size = np.array([view.camera.width, view.camera.height])
        low = rng.integers(0, (size - 64) // 16 + 1) * 16
        high = np.minimum(low + rng.integers(4, 20, 2) * 16, size)
        windows[view.name] = (*low.tolist(), *high.tolist())
    return windows


@pytest.mark.parametrize("most", [2, 3, 8])
def test_windows_of_few_sizes_hold_the_given_ones(most):
    rng = np.random.default_rng(most)
    views = [view_of(f"v{i}", *((509, 383) if i % 3 else (320, 240))) for i in range(40)]
    windows = some_windows(rng, views)
    enlarged = of_few_sizes(windows, views, most)
    sizes, given, used = set(), 0, 0
    for view in views:
        whole = (0, 0, view.camera.width, view.camera.height)
        left, top, right, bottom = enlarged.get(view.name, whole)
        low_x, low_y, high_x, high_y = windows.get(view.name, whole)
        assert 0 <= left <= low_x and high_x <= right <= whole[2]
        assert 0 <= top <= low_y and high_y <= bottom <= whole[3]
        for start, end in ((left, whole[2] - right), (top, whole[3] - bottom)):
            assert start % 16 == 0 or end == 0
        sizes.add((whole[2:], right - left, bottom - top))
        given += (high_x - low_x) * (high_y - low_y)
        used += (right - left) * (bottom - top)
    assert len(sizes) == most and used < {2: 10, 3: 4, 8: 1.6}[most] * given


def test_a_view_that_is_read_whole_has_no_window():
    views = [view_of("a", 320, 240), view_of("b", 320, 240)]
    assert of_few_sizes({}, views) == of_few_sizes({}, []) == {}
    assert of_few_sizes({"a": (0, 0, 304, 240)}, views, 1) == {}
    assert of_few_sizes({"a": (16, 0, 320, 240)}, views, 2) == {"a": (16, 0, 320, 240)}


POSITIONS = np.array([[-1.0, 0, 9], [-1, 1, 9], [1, 0, 9], [0, 0, -9], [50, 0, 9]])
OWNER = np.array([0, 0, 1, 1, -1])


def test_shares_count_what_a_view_shows():
    views = [view_of("a", 320, 240), view_of("b", 2000, 240)]
    shares = owned_shares(OWNER, POSITIONS, views, 0.1, 3)
    assert np.allclose(shares, [[2 / 3, 1 / 3, 0], [2 / 4, 1 / 4, 0]])
    away = owned_shares(OWNER, POSITIONS - [0, 0, 100], views, 0.1, 3)
    assert not away.any()
    many = np.random.default_rng(0).integers(0, 5, 100_000)
    found = owned_shares(OWNER[many], POSITIONS[many], views, 0.1, 3)
    assert np.allclose(found, shares, atol=0.02)


def test_blocks_visit_views_by_their_shares_but_not_more_often_in_all_than_one_run():
    scene = SimpleNamespace(views=[view_of("a", 320, 240), view_of("b", 2000, 240)], near_plane=0.1)
    gaussians = Gaussians.from_points(POSITIONS, np.zeros((5, 3)), 0)
    both = np.array([0, 1])
    partition = SimpleNamespace(regions=[None] * 3, views=(both, both, both[1:]))
    visits = visits_of_blocks(partition, scene, gaussians, OWNER, 2.0)
    fewer = visits_of_blocks(partition, scene, gaussians, OWNER, 1.2)
    assert np.allclose(fewer[0], [0.8, 0.6]) and np.allclose(fewer[1], 0.6 * visits[1])
    assert np.allclose(visits[0], [8 / 7, 6 / 7]) and np.allclose(visits[1], [2 / 3, 1 / 2])
    assert visits[2] == 0.01


def test_shares_of_pixels_add_up(city):
    """Cells that own all places, each once, are shown by all pixels."""
    inner = region_of(city, 0.4)
    outer = replace(inner, low=np.where(np.isfinite(inner.high), inner.high, -np.inf), high=np.full(3, np.inf))
    whole = sum(view.camera.width * view.camera.height for view in city.views)
    for scene in (city, replace(city, observations=None)):
        parts = [seen_pixels(scene, region, scene.views) for region in (inner, outer)]
        assert abs(sum(parts) - whole) <= 2 and min(parts) > 0.2 * whole
    assert sum(seen_pixels(city, inner, (view,)) for view in city.views) == pytest.approx(
        seen_pixels(city, inner, city.views), abs=len(city.views)
    )
