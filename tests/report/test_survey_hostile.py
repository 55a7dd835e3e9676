"""The section Survey of reports: scenes and records of every kind, and what each of them shows."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.evaluation.survey import spreads, survey_of
from clsplat.georeference import Georeference, Residual
from clsplat.report.run import write_report
from clsplat.report.survey import NO_RESIDUAL, area, facts, length, survey_html, survey_maps
from clsplat.scene import Scene, View
from tests.evaluation.test_pictures import pictures
from tests.report.test_report import Balanced, bare_run, headings

SFM = {
    "photos": 42,
    "registered": 40,
    "points": 1200,
    "mean_track_length": 5.25,
    "reprojection_error_pixels": 0.734,
    "not_registered": {"a<b>.jpg": "matches no other photo"},
}


def flight(count=12, names="{}.jpg"):
    """A scene of nadir photos in a row, 20 m apart, in a georeferenced frame: 10 cm a pixel."""
    random = np.random.default_rng(0)
    points = np.column_stack([random.uniform(-100, 100, (4000, 2)), random.normal(0, 0.1, 4000)])
    views = []
    for number in range(count):
        x = 20.0 * (number - (count - 1) / 2)
        camera = Camera.looking_at((x, 0, 0), (x, 0, 50), up=(0, 1, 0), width=800, height=600)
        views.append(View(names.format(number), replace(camera, focal=(500.0, 500.0)), Path("x")))
    place = Georeference("EPSG:32614", (587670.0, 3338097.0, 309.0), "GPS of 12 photos", 0.5)
    return Scene("flight", tuple(views), points, np.zeros((4000, 3), np.uint8), georeference=place)


def residual(name, role="control", pixels=None, east=0.3, north=0.4, up=1.2):
    return Residual(name, role, east, north, up, pixels)


def measured(scene, residuals=(), said=(), size=0.0, vertical=""):
    """The scene with the fields that newer georeferences have."""
    return replace(
        scene,
        georeference=replace(
            scene.georeference, residuals=tuple(residuals), warnings=tuple(said), size=size, vertical=vertical
        ),
    )


def stored(scene, folder, record):
    """The scene in a folder whose sfm.json holds this text, or this record."""
    text = record if isinstance(record, str) else json.dumps(record)
    (folder / "sfm.json").write_text(text, "utf-8")
    return replace(scene, path=folder)


def words_of(html):
    """A page without its pictures, which must be balanced."""
    Balanced(html)
    return re.sub('data:[^"]+', "", html)


def test_numbers_of_a_flight_that_can_be_computed_by_hand(tmp_path):
    scene = stored(measured(flight(), vertical="EGM96 height", size=250.0), tmp_path, SFM)
    survey = survey_of(scene)
    found = dict(facts(survey))
    assert found["photos used"] == "12 of 42" and found["points of the sparse model"] == "1,200"
    assert found["ground sampling distance"] == "10 cm a pixel of the photos"  # 50 m / 500
    assert found["distance of the ground"] == "50 m from the cameras, median"
    assert found["heights"] == "EGM96 height"
    assert found["reprojection error, pixels"] == "0.73"
    assert found["residual"] == "50 cm along the ground, RMS; the flight extends over 250 m"
    # photos of 80 m by 60 m every 20 m: a place below the flight is in four of them
    middle = survey.overlap.counts[survey.overlap.counts.shape[0] // 2]
    assert np.median(middle) == 4
    assert survey.overlap.covered == pytest.approx(200 * 60, rel=0.05)  # as the points end there


def test_residuals_by_axis():
    found = spreads([residual("a", east=3, north=4, up=None), residual("b", east=-3, north=4, up=2)])
    assert (found["east"].mean, found["east"].sigma, found["east"].rms) == (0, 3, 3)
    assert found["north"].mean == 4 and found["north"].sigma == 0
    assert found["up"].mean == found["up"].rms == 2  # of the one that is known
    assert found["along the ground"].rms == found["along the ground"].within_90 == 5
    assert spreads([]) == {} and "up" not in spreads([residual("a", up=None)])


ROWS = [residual("0.jpg"), residual("1.jpg", "left out", east=300), residual("<GCP>", "check", 1.5)]
# name -> (scene, words that the section has, words that it lacks); None: there is no section
SCENES = {
    "neither": (lambda: replace(flight(), georeference=None), None, ()),
    "older georeference": (
        flight,
        ("50 cm along the ground", "unknown: the vertical system"),
        ("Warning", "Residuals:", "extends over"),
    ),
    "residuals": (
        lambda: measured(flight(), ROWS),
        (
            "Residuals: GPS of photos, which decided the place (1)",
            "Residuals: ground control points, which took no part (1)",
            "&lt;GCP&gt;",
            "CE90",
            "left out</td><td>1.jpg",
        ),
        ("<GCP>",),
    ),
    "no points": (
        lambda: replace(flight(), points=np.zeros((0, 3)), colours=np.zeros((0, 3), np.uint8)),
        ("photos used",),
        ("overlap</td>", "sampling"),
    ),
    "points that are not finite": (
        lambda: replace(flight(), points=np.where(np.arange(4000)[:, None] < 9, np.nan, flight().points)),
        ("photos look at a place",),
        (),
    ),
    "names with markup": (
        lambda: measured(flight(names="<b>{}.jpg"), [residual("<b>0.jpg", "left out")]),
        ("&lt;b&gt;0.jpg",),
        ("<b>0.jpg",),
    ),
}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", SCENES)
def test_a_section_of_what_is_known(name):
    make, words, lacking = SCENES[name]
    html = words_of(survey_html(make()))
    assert (html == "") is (words is None)
    for word in words or ():
        assert word in html
    for word in (*lacking, "could not be"):
        assert word not in html
    assert not re.search(r"\b(nan|inf|None)\b", html)


RECORDS = {
    "whole": (SFM, ("12 of 42", "Photos that were not used", "a&lt;b&gt;.jpg", "0.73"), ()),
    "warnings": (
        {"warnings": ["not <georeferenced>", "not <georeferenced>"]},
        ("Warning: not &lt;georeferenced&gt;",),
        ("<georeferenced>",),
    ),
    "cut": (json.dumps(SFM)[:40], ("<td>12</td>",), ("reprojection",)),
    "words for numbers": ({"photos": "many", "points": "<x>"}, ("survey could not be",), ("<x>",)),
}


@pytest.mark.one_in(5)
@pytest.mark.parametrize("name", RECORDS)
def test_a_record_of_sfm_that_is_damaged_costs_no_page(name, tmp_path):
    record, words, lacking = RECORDS[name]
    html = words_of(survey_html(stored(flight(), tmp_path, record)))
    assert all(word in html for word in words) and not any(word in html for word in lacking)


def test_a_camera_is_coloured_by_its_residual_if_that_is_known():
    scene = measured(
        flight(3),
        [residual("0.jpg"), residual("0.jpg", pixels=2.0, east=99.0), residual("2.jpg", "left out", east=5.0, up=None)],
    )
    found = survey_of(scene).camera_residuals
    assert found[0] == pytest.approx(1.3) and np.isnan(found[1]) and found[2] > 5
    html = survey_maps(survey_of(scene))
    assert re.findall("<h4>(.*?)</h4>", html) == ["cameras, by their residual", "overlap"]
    colours = re.findall('<circle [^>]*fill="(.*?)"', html)
    assert colours[1] == NO_RESIDUAL and colours[2] == "rgb(253 231 37)" != colours[0]
    assert html.count("stroke=") == html.count("left out</title>") == 1
    assert "0.jpg, 1.3 m from its GPS" in html and "north is upwards" in html
    html = survey_maps(survey_of(flight(3)))
    places = np.array(re.findall('<circle cx="(.*?)" cy="(.*?)"', html), float)
    assert np.allclose(np.diff(places[:, 0]), 20) and np.ptp(places[:, 1]) == 0
    assert "<h4>cameras</h4>" in html
    assert "north" not in survey_maps(survey_of(replace(flight(3), georeference=None)))


@pytest.mark.parametrize(
    "metres, words", [(0.0054, "5.4 mm"), (0.049, "4.9 cm"), (57.04, "57 m"), (999.0, "999 m"), (12345.6, "12,346 m")]
)
def test_lengths_for_people(metres, words):
    assert length(metres) == words


@pytest.mark.parametrize(
    "square, words", [(85.0, "85 m²"), (11400, "1.14 ha"), (2.4e6, "240 ha"), (3.2e7, "3,200 ha"), (0.0, "0 m²")]
)
def test_areas_for_people(square, words):
    assert area(square) == words


def test_a_survey_stands_between_pictures_and_scores(tmp_path):
    run = bare_run(tmp_path / "run")
    run.log({"event": "eval", "iteration": 9, "psnr": 21.0})
    html = write_report(run, pictures=pictures(), scene=flight()).read_text()
    assert headings(html)[:3] == ["Held-out views", "Survey", "Scores"]


def test_what_positions_changed_is_a_fact(tmp_path):
    said = "adjusted to the positions of 40 photos"
    scene = stored(flight(), tmp_path, {**SFM, "position_priors": {"photos": 40, "text": said}})
    assert dict(facts(survey_of(scene)))["positions as priors"] == said
    assert said in survey_html(scene)
