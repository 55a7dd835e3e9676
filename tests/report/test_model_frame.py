"""A model in a notebook: its page in a frame, of any model, and what is said of it."""

import html
import re

import numpy as np
import pytest

from clsplat.gaussians import Gaussians
from clsplat.report import notebook
from clsplat.report.notebook import likely_up, model_frame, smaller
from tests.apps.browser import answer_of, needs_chromium


def ground(count=500, offset=(0.0, 0.0, 0.0), **changed):
    """Opaque gaussians on a floor of 20 by 20 by 1."""
    random = np.random.default_rng(0)
    made = max(2, count)
    rows = Gaussians.from_points(random.uniform((-10, -10, 0), (10, 10, 1), (made, 3)),
                                 random.integers(0, 255, (made, 3), np.uint8), 1).rows
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


@pytest.mark.parametrize("axes, up", [
    (np.eye(3), (0, 0, 1)), (np.eye(3)[[0, 2, 1]], (0, -1, 0))], ids=["flat in z", "flat in y"])
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
