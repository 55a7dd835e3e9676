"""The pages of a report of a survey: what they say, that nothing overlaps or leaves the paper."""

import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from clsplat.evaluation.survey import survey_of
from clsplat.report.figures import own_settings
from clsplat.report.figures.map_preview import TINTS
from clsplat.report.figures.survey import Sheet, drawn_pages, write_pages
from clsplat.report.page import Table
from clsplat.report.survey import facts, residual_tables, warnings
from tests.report.test_survey_hostile import flight, measured, residual

POINTS = [
    residual(f"point {number} at the corner of the northern field", "check", 1.5, up=0.123) for number in range(70)
]
BOUNDS = 587_000.0, 3_338_000.0, 587_400.0, 3_338_200.0
SHEETS = [
    Sheet(
        "Surface",
        "Heights above the ellipsoid. " * 5,
        np.full((40, 80, 3), 0.5),
        BOUNDS,
        "m",
        True,
        (12.0, 48.0, TINTS, "height, m"),
    ),
    Sheet(
        "Coverage",
        "Dots.",
        np.where(np.eye(20) > 0, np.nan, 7.0),
        (0, 0, 0.2, 0.2),
        "scene units",
        False,
        (0, 9, "viridis", "photos"),
        np.array([[0.3, 0.1]]),
    ),
]


def content():
    survey = survey_of(measured(flight(), POINTS, ["the receiver had no fix " * 9], 250.0, "EGM96"))
    return [
        "Survey of $a$ field",
        "clsplat",
        [
            Table("Warnings", ("",), [(text,) for text in warnings(survey)]),
            Table("Survey", ("", ""), list(facts(survey))),
            Table("none", ("", ""), []),
            *residual_tables(survey),
        ],
        SHEETS,
    ]


@pytest.fixture(scope="module")
def pages():
    with own_settings():
        figures = drawn_pages(*content())
        for figure in figures:
            FigureCanvasAgg(figure).draw()
        yield figures


def words(figure):
    return [text.get_text() for text in figure.texts]


@pytest.mark.slow
def test_what_the_pages_say(pages):
    first, *_, surface, coverage = pages
    said = " ".join(words(first))
    for text in (
        "Survey of $a$ field",
        "Warnings the receiver",
        "EGM96",
        "10 cm a pixel",
        "12 photos",
        "extends over 250 m",
    ):
        assert text in " ".join(said.split())
    table = sum((words(page) for page in pages[:-2]), [])
    assert sum(text.startswith("point ") for text in table) == 70
    assert table.count("0.123") == 70 + 3, "of the points, and mean, RMS and 90 %"
    assert "none" not in table, "a table without rows"
    for number, page in enumerate(pages, 1):
        assert f"{number} of {len(pages)}" in words(page)
    assert words(surface)[0] == "Surface" and surface.axes[1].get_xlabel() == "height, m"
    north = [[text.get_text() for text in page.axes[0].texts] for page in (surface, coverage)]
    assert north == [["N"], []], "an arrow only where north is known"
    assert surface.axes[0].get_xlabel() == "east, m"
    assert coverage.axes[0].get_xlabel() == "scene units"
    bars = [page.axes[0].artists[0] for page in (surface, coverage)]
    assert [bar.txt_label.get_text() for bar in bars] == ["100 m", "0.05 scene units"]
    bar = bars[0].size_bar.get_children()[0]
    assert bar.get_width() == 100, "in the coordinates of the map"
    low, high = coverage.axes[0].get_xlim()
    assert low < 0 and high > 0.3, "dots beyond the map are shown"


@pytest.mark.slow
def test_nothing_overlaps_or_leaves_the_paper(pages):
    for page in pages:
        paper = page.bbox
        boxes = [
            (text.get_text(), text.get_window_extent())
            for text in [*page.texts, *(label for axes in page.axes for label in (axes.xaxis.label, axes.yaxis.label))]
            if text.get_text().strip()
        ]
        for number, (text, box) in enumerate(boxes):
            assert paper.x0 < box.x0 and box.x1 < paper.x1, text
            assert paper.y0 < box.y0 and box.y1 < paper.y1, text
            for other, beside in boxes[:number]:
                assert not box.shrunk(0.9, 0.7).overlaps(beside.shrunk(0.9, 0.7)), (text, other)
        for axes in page.axes:
            frame = axes.get_tightbbox()
            assert paper.x0 < frame.x0 and frame.x1 < paper.x1, "labels of a map"


def test_the_same_survey_gives_the_same_bytes():
    files = []
    for title in ("Survey", "Survey", "Other"):
        file = io.BytesIO()
        write_pages(file, title, "clsplat", [], SHEETS[:1])
        files.append(file.getvalue())
    assert files[0] == files[1] != files[2] and files[0].startswith(b"%PDF")
    assert b"/Title" in files[0] and b"Date" not in files[0]


def test_a_report_of_a_scene_without_a_place():
    survey = survey_of(replace(flight(), georeference=None))
    assert "none, so sizes are not known in metres" in dict(facts(survey)).values()
    assert residual_tables(survey) == []
