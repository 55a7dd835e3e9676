"""Scores of views: alike however many are scored at the same time."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.evaluation import views as views_module
from clsplat.evaluation.views import evaluate_views, opened
from clsplat.gaussians import Gaussians
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from tests.data.tiny_training import CITY


@pytest.fixture(scope="module")
def city():
    return read_scene(CITY).reduced(8)


def test_views_are_scored_in_their_order_whatever_their_number_at_once(city, item_device, monkeypatch):
    model = opened(item_device, Gaussians.from_points(city.points, city.colours, 0), city, resolve({}, {}))
    some = city.views[:7]

    def result(pixels_at_once):
        monkeypatch.setattr(
            views_module,
            "host_memory",
            lambda: views_module.SCORED_PIXEL_BYTES * pixels_at_once / views_module.SCORING_SHARE * 1.01,
        )
        monkeypatch.setattr(views_module.os, "cpu_count", lambda: 4)
        kept = []
        scores = evaluate_views(*model, some, lambda *given: kept.append(given))
        assert [view.name for view, *_ in kept] == [view.name for view in some]
        assert all(np.array_equal(photo, views_module.photo_of(view)) for view, _, _, photo, _ in kept)
        return scores

    pixels = some[0].camera.width * some[0].camera.height
    alone = result(1)
    assert [scores["name"] for scores in alone["per_view"]] == [view.name for view in some]
    assert len({scores["psnr"] for scores in alone["per_view"]}) == 7
    assert result(3 * pixels) == result(100 * pixels) == alone


@pytest.mark.parametrize(
    "width, cores, at_once", [(100, 128, 100), (100, 4, 4), (100, None, 1), (9000, 64, 1), (1000, 64, 10), (1000, 1, 1)]
)
def test_as_many_are_scored_at_once_as_fit(city, monkeypatch, width, cores, at_once):
    monkeypatch.setattr(views_module, "host_memory", lambda: 16e9)
    monkeypatch.setattr(views_module.os, "cpu_count", lambda: cores)
    view = city.views[0]
    large = replace(view, camera=replace(view.camera, width=width, height=1000))
    assert views_module.scored_at_once([large, view]) == at_once
    assert views_module.scored_at_once([]) == (cores or 1)
