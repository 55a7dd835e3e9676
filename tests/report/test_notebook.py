"""How scenes, views and cameras show themselves in notebooks."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.api.score import Score
from clsplat.camera import Camera
from clsplat.io.photos.images import write_image
from clsplat.report.notebook import scene_page, view_card
from clsplat.scene import View
from tests.report.test_survey_hostile import flight, words_of

CAMERA = Camera(64, 48, (50.0, 50.0), (32.0, 24.0), np.eye(3), np.array([0.0, 0.0, 2.0]))


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.png"
    write_image(path, np.full((48, 64, 3), 0.5, np.float32))
    return path


def test_objects_are_one_short_line(photo):
    view = View("a.jpg", CAMERA, photo)
    score = Score(5, 27.0, 0.875, 28.5, 0.9, ({"name": "a.jpg"},) * 999)
    assert repr(CAMERA) == "<clsplat.Camera 64 x 48, focal length 50, at (0, 0, -2)>"
    assert repr(view) == "<clsplat.View 'a.jpg': 64 x 48>"
    assert repr(score) == ("<clsplat.Score of 5 views: PSNR 27.00 dB (28.50 after the colour fit), "
                           "SSIM 0.8750>")


def test_a_view_shows_its_photo_and_its_camera(photo):
    html = view_card(View("a <b>.jpg", CAMERA, photo))
    assert "data:image/jpeg;base64," in html and "width=64 height=48" in html
    assert "a &lt;b&gt;.jpg<br>64 x 48, focal length 50 pixels" in words_of(html)
    large = replace(CAMERA, width=6400, height=4800, focal=(5e3, 5e3))
    assert "width=320 height=240" in view_card(View("a", large, photo))  # never the whole photo


@pytest.mark.parametrize("count, photos", [(0, 0), (1, 1), (12, 12), (13, 7), (60, 12)])
@pytest.mark.one_in(2)
def test_a_scene_shows_a_map_and_some_photos(count, photos, photo):
    scene = flight(max(1, count))
    scene = replace(scene, views=tuple(replace(view, source=photo) for view in scene.views[:count]))
    html = scene_page(scene)
    words_of(html)
    assert html.count("<figure") == photos and ('class="maps' in html) is (count > 0)
    if count:
        assert f"{count}, 800 x 600 pixels" in html and "4,000" in html
