"""Pictures of a report: which views, how they are made, and where they stand in the page."""

import base64
import re

import matplotlib
import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.evaluation import views
from clsplat.evaluation.pictures import COLOURS, LARGEST_ERROR, Pictures, chosen_views, error_map, shown_view
from clsplat.io.photos.images import read_image, write_image
from clsplat.io.runs.run import RunFolder
from clsplat.report.run import write_report
from clsplat.scene import View
from tests.report.test_report import Balanced, headings


def scored(name, psnr, size=(8, 6)):
    """(its part of per_view, fitted render, photo) of a made-up view."""
    width, height = size
    photo = np.linspace(0, 1, height * width * 3).reshape(height, width, 3)
    scores = {"name": name, "psnr": psnr - 1, "ssim": 0.7, "psnr_cc": psnr, "ssim_cc": 0.8}
    return scores, np.clip(photo + 0.1, 0, 1), photo


def pictures(held_out=True, size=(8, 6), names=("a.jpg", "b.jpg", "c.jpg")):
    return Pictures(
        [
            shown_view(place, *scored(name, psnr, size))
            for place, name, psnr in zip(("worst", "median", "best"), names, (18.0, 22.0, 25.0))
        ],
        held_out,
        7,
    )


@pytest.fixture
def run(tmp_path):
    """A run that was evaluated once, so that its page has no figures, which take time."""
    run = RunFolder.create(tmp_path / "run")
    run.write_options({"scene": "/data/city"})
    run.log({"event": "eval", "iteration": 9, "psnr_cc": 21.0})
    return run


@pytest.mark.parametrize(
    "scores, chosen",
    [
        ([20, 30, 10, 25, 15], [("worst", 2), ("median", 0), ("best", 1)]),
        ([20, float("nan"), 30], [("worst", 1), ("median", 0), ("best", 2)]),
        ([20, 30, 25, float("inf")], [("worst", 0), ("median", 1), ("best", 3)]),
        ([30, 20], [("worst", 1), ("best", 0)]),
        ([20], [("only", 0)]),
        ([], []),
    ],
)
def test_which_views_are_shown(scores, chosen):
    assert chosen_views([{"psnr_cc": score} for score in scores]) == chosen


def test_chosen_views_are_rendered_again_and_no_others(monkeypatch):
    asked, sides = [], set()
    camera = Camera(8000, 6000, (6e3, 6e3), (4e3, 3e3), np.eye(3), np.zeros(3))

    def evaluate_views(renderer, rows, degree, chosen, keep=None, metrics=None, predicted=None):
        assert metrics == {} or not keep, "scores are known"
        asked.append([view.name for view in chosen])
        sides.update(max(view.camera.width, view.camera.height) for view in chosen)
        found = [scored(view.name, float(view.name.removesuffix(".jpg"))) for view in chosen]
        for _, fitted, photo in found if keep else ():
            keep(None, None, fitted, photo, None)
        return {"per_view": [scores for scores, *_ in found]}

    def named(*scores):
        return [View(f"{psnr}.jpg", camera, b"") for psnr in scores]

    monkeypatch.setattr(views, "evaluate_views", evaluate_views)
    held_out = named(25, 18, 20, 30)
    known = evaluate_views(None, None, None, held_out)["per_view"]
    asked.clear()
    found = views.pictures_of(None, None, 0, held_out, named(1, 2), known)
    assert asked == [["18.jpg", "25.jpg", "30.jpg"]] and found.held_out and found.count == 4
    assert [(view.place, view.scores["name"]) for view in found.shown] == [
        ("worst", "18.jpg"),
        ("median", "25.jpg"),
        ("best", "30.jpg"),
    ]
    asked.clear()
    assert sides == {8000}  # scores are those of the whole photo
    sides.clear()
    found = views.pictures_of(None, None, 0, [], named(*range(100)))
    assert sides == {views.SAMPLED_SIDE}  # floats of a whole one take gigabytes
    assert not found.held_out and found.count == len(asked[0]) <= views.MOST_SAMPLED
    assert [view.scores["name"] for view in found.shown][0] == "0.jpg"  # spread over all of them
    assert int(asked[0][-1].removesuffix(".jpg")) > 90


def test_the_error_map_has_a_scale_that_is_even():
    photo = np.full((1, 6, 3), 0.5)
    render = photo + np.array([0, LARGEST_ERROR / 2, -LARGEST_ERROR / 2, LARGEST_ERROR, -0.5, np.nan])[:, None]
    got = error_map(render, photo)
    assert got.dtype == np.uint8
    first, middle, last = COLOURS[0], COLOURS[len(COLOURS) // 2], COLOURS[-1]
    assert [tuple(pixel) for pixel in got[0]] == [first, middle, middle, last, last, last]
    one = np.zeros((1, 1, 3))
    one[..., 0] = LARGEST_ERROR * 1.5  # of one channel: half the largest as a mean
    assert tuple(error_map(one, np.zeros((1, 1, 3)))[0, 0]) == middle
    ramp = np.linspace(0, LARGEST_ERROR, 256)[None, :, None] * np.ones(3)
    inferno = matplotlib.colormaps["inferno"](np.linspace(0, 1, 256))[:, :3] * 255
    assert abs(error_map(ramp, 0 * ramp)[0] - inferno).max() < 10


def test_a_report_begins_with_pictures(run):
    html = write_report(run, pictures=pictures(names=("a<b.jpg", "b.jpg", "c.jpg"))).read_text()
    Balanced(html)
    assert html.count("<img ") == 9
    assert headings(html)[:2] == ["Held-out views", "Scores"]
    assert "Worst: a&lt;b.jpg" in html and "Best: c.jpg" in html
    assert "<p>PSNR 18.00 dB (poor), SSIM 0.8000</p>" in html
    assert "a PSNR from 28 dB is very good" in html
    assert (
        re.findall("<figcaption>(.*?)</figcaption>", html) == ["photo", "render after the colour fit", "its error"] * 3
    )
    assert f"{LARGEST_ERROR:.0%} of full brightness" in html
    data = re.search(r'alt="error of c.jpg".*?base64,([^"]+)"', html)[1]
    seen = read_image(base64.b64decode(data)).reshape(-1, 3).mean(0)
    assert abs(seen - shown_view("best", *scored("c", 20.0)).error.reshape(-1, 3).mean(0)).max() < 9


def test_scores_that_are_added_are_in_the_next_report(run):
    run.log({"event": "eval", "iteration": 20, "psnr_cc": 22.0})
    run.log({"event": "step", "iteration": 20})
    assert "FLIP cc" not in write_report(run).read_text()
    run.add_scores({"flip": 0.1234, "flip_cc": 0.05})
    assert [record.get("flip") for record in run.records()] == [None, 0.1234, None]
    html = write_report(run, pictures()).read_text()
    assert "FLIP cc" in html and "0.1234" in html
    assert html.count("PSNR cc, dB") == 1
    (run.path / "metrics.jsonl").unlink()
    run.add_scores({"flip": 0.5})
    assert run.records() == [] and "has no records" in write_report(run).read_text()


def test_a_city_has_its_map_and_its_tables_in_each_report(run, tmp_path):
    share = {"block": 7, "state": "trained", "gaussians": 5, "trained": 6, "views": 3, "points": 9, "note": ""}
    border = {"blocks": [0, 1], "pixels": 12, "psnr": 20.0, "elsewhere_psnr": 21.0, "seam_db": 0.5}
    write_image(run.path / "partition.png", np.zeros((2, 3, 3), np.uint8))
    run.log({"event": "merge", "blocks": [share], "dropped": {}})
    assert headings(write_report(run).read_text())[-1] == "Blocks"
    run.log({"event": "seams", "borders": [border], "seam_db": 0.5})
    html = write_report(run, pictures()).read_text()
    assert headings(html)[0] == "Held-out views" and headings(html)[-2:] == ["Blocks", "Seams"]
    assert "<td>007</td>" in html and "<td>000 | 001</td>" in html and "map of the blocks" in html
