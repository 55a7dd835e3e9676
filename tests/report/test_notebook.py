"""How scenes, views, cameras and models show themselves in notebooks."""

import html
import re
from dataclasses import replace

import numpy as np
import pytest

from clsplat.api.score import Score
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.io.photos.images import write_image
from clsplat.report import notebook
from clsplat.report.notebook import likely_up, model_frame, scene_page, smaller, view_card
from clsplat.scene import View
from tests.apps.browser import answer_of, needs_chromium
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
    assert repr(score) == ("<clsplat.Score of 5 views: PSNR 27.00 dB (28.50 after the colour fit), SSIM 0.8750>")


def test_a_view_shows_its_photo_and_its_camera(photo):
    shown = view_card(View("a <b>.jpg", CAMERA, photo))
    assert "data:image/jpeg;base64," in shown and "width=64 height=48" in shown
    assert "a &lt;b&gt;.jpg<br>64 x 48, focal length 50 pixels" in words_of(shown)
    large = replace(CAMERA, width=6400, height=4800, focal=(5e3, 5e3))
    assert "width=320 height=240" in view_card(View("a", large, photo))  # never the whole photo


@pytest.mark.parametrize("count, photos", [(0, 0), (1, 1), (12, 12), (13, 7), (60, 12)])
@pytest.mark.one_in(2)
def test_a_scene_shows_a_map_and_some_photos(count, photos, photo):
    scene = flight(max(1, count))
    scene = replace(scene, views=tuple(replace(view, source=photo) for view in scene.views[:count]))
    shown = scene_page(scene)
    words_of(shown)
    assert shown.count("<figure") == photos and ('class="maps' in shown) is (count > 0)
    if count:
        assert f"{count}, 800 x 600 pixels" in shown and "4,000" in shown


def ground(count=500, offset=(0.0, 0.0, 0.0), **changed):
    """Opaque gaussians on a floor of 20 by 20 by 1."""
    random = np.random.default_rng(0)
    made = max(2, count)
    rows = Gaussians.from_points(
        random.uniform((-10, -10, 0), (10, 10, 1), (made, 3)), random.integers(0, 255, (made, 3), np.uint8), 1
    ).rows
    rows = {name: values[:count] for name, values in rows.items()}
    rows = {**rows, "opacity_logits": np.full(count, 3.0, np.float32), **changed}
    return Gaussians(rows, 1, np.array(offset))


def page_of(shown):
    return html.unescape(re.search('srcdoc="([^"]*)"', shown)[1])


def test_a_model_shows_its_page_in_a_frame():
    shown = model_frame(ground())
    assert shown.startswith("<iframe srcdoc=") and 'sandbox="allow-scripts"' in shown
    assert page_of(shown).lstrip().lower().startswith("<!doctype html>")
    assert "<p>500 gaussians, SH degree 1</p>" in shown


def test_a_large_model_is_shown_by_a_smaller_one(monkeypatch):
    monkeypatch.setattr(notebook, "MOST_SHOWN", 100)
    shown = model_frame(ground(500))
    assert "500 gaussians, SH degree 1; 100 are shown here" in shown
    logits = np.full(500, -2.0, np.float32)
    logits[::5] = 5.0  # a hundred that are opaque
    kept = smaller(ground(500, opacity_logits=logits))
    assert kept.count == 100 and np.median(kept.opacity_logits) > 0


@pytest.mark.parametrize(
    "axes, up", [(np.eye(3), (0, 0, 1)), (np.eye(3)[[0, 2, 1]], (0, -1, 0))], ids=["flat in z", "flat in y"]
)
def test_up_is_the_thin_side(axes, up):
    assert np.array_equal(likely_up(ground().positions.astype(np.float64) @ axes), up)


@needs_chromium
@pytest.mark.slow
def test_the_frame_is_drawn(tmp_path):
    """The sandbox of the frame lets its scripts and its worker run."""
    shown = model_frame(ground())
    said = html.escape("""<script>setInterval(() => {
        if (viewer?.ordered) parent.postMessage("drawn", "*"); }, 100);</script>""")
    shown = shown.replace('" sandbox', f'{said}" sandbox')
    cell = f"<script>onmessage = ({{ data }}) => window.found = data;</script>{shown}"
    assert answer_of(tmp_path, cell, "await until(() => page.found); return page.found;") == "drawn"
