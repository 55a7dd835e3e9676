"""The pictures that a training and `clsplat eval` leave for a person to look at."""

import re

import numpy as np
import pytest

from clsplat.evaluation.pictures import error_map
from clsplat.io.photos.images import read_image
from tests.command_line import clsplat_
from tests.data.tiny_training import STILL, trained


@pytest.fixture(scope="module")
def run(item_device, city, tmp_path_factory):
    return trained(tmp_path_factory.mktemp("pictures") / "run", city, item_device, **STILL, iterations=20)


def shown(run):
    """(heading, [names of the views]) of the pictures with which a run's page begins."""
    html = (run.path / "report.html").read_text()
    return (re.search("<h2>(.*?)</h2>", html)[1], re.findall("<h3>(?:Worst|Median|Best): (.*?)</h3>", html))


def test_the_report_of_a_training_begins_with_held_out_views(run, city):
    heading, names = shown(run)
    assert heading == "Held-out views"
    held_out = {view.name for view in city.split(8)[1]}
    assert len(set(names)) == 3 and set(names) <= held_out


@pytest.mark.slow
def test_eval_writes_panels_that_it_names_and_renews_the_report(run):
    page = run.path / "report.html"
    whole = page.read_text()
    before = shown(run)
    page.write_text(whole.replace("<h3>", "<h3>Old "))
    words = "eval", run.path, "--device", "cpu"
    done = clsplat_(*words, "--no-images")
    assert done.exit_code == 0, done.output
    assert "<h3>Old" in page.read_text() and not (run.path / "renders").exists()
    done = clsplat_(*words)
    assert done.exit_code == 0, done.output
    assert "left to right: photo, render, render after the colour fit, its error" in done.output
    assert f"report: {page}" in done.output
    assert shown(run) == before and len(page.read_text()) == pytest.approx(len(whole), rel=0.05)
    files = sorted((run.path / "renders" / "test").glob("*.png"))
    assert len(files) == 4
    photo, _, fitted, error = np.split(read_image(files[0]), 4, axis=1)
    expected = error_map(fitted / 255, photo / 255).astype(int)
    assert np.abs(error.astype(int) - expected).mean() < 3  # the fit is rounded in the file
