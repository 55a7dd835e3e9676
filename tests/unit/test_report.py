"""Curves from records, the page of a run, tables; parts that a run lacks are left out."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

from clsplat.io.run import RunFolder
from clsplat.report.curves import (
    band,
    curve,
    frequency_curves,
    reached,
    spread,
    value_at,
)
from clsplat.report.page import Table, page, picture
from clsplat.report.run import level_table, score_table, write_report
from tests.made_runs import made_records, made_run

LINE = (np.array([1.0, 3.0, 5.0]), np.array([10.0, 20.0, 16.0]))
NOTHING = (np.zeros(0), np.zeros(0))


def test_a_curve_keeps_points_with_both_numbers():
    records = [{"event": "eval", "t": 1, "v": 2}, {"event": "step", "t": 2, "v": 3},
               {"event": "eval", "t": 3, "v": None}, {"event": "eval", "t": 4},
               {"event": "eval", "t": 0, "v": 0}]
    assert [list(part) for part in curve(records, "t", "v", "eval")] == [[1, 0], [2, 0]]
    assert [list(part) for part in curve(records, "t", "v")] == [[1, 2, 0], [2, 3, 0]]
    assert [len(part) for part in curve([], "t", "v")] == [0, 0]


def test_values_are_linear_between_points_and_unknown_outside():
    assert [value_at(LINE, when) for when in (1, 2, 3, 4.5, 5)] == [10, 15, 20, 17, 16]
    assert [value_at(LINE, when) for when in (0.9, 5.1)] == [None, None]
    assert value_at(NOTHING, 1) is None


@pytest.mark.parametrize("level, answer", [
    (12.5, (1.5, False)), (20, (3.0, False)), (10, (1.0, True)), (7, (1.0, True)), (20.1, None)])
def test_when_a_level_is_reached(level, answer):
    assert reached(LINE, level) == answer
    assert reached(NOTHING, level) is None


def test_a_level_counts_from_where_it_is_first_reached():
    assert reached((np.arange(5.0), np.array([0.0, 8, 4, 8, 9])), 6) == (0.75, False)


def test_band():
    other = (np.array([2.0, 6.0]), np.array([11.0, 31.0]))
    x, mean, low, high = band([LINE, other, NOTHING])
    assert list(x) == [2, 3, 5]  # where both are known, at the points of either
    assert list(low) == [11, 16, 16] and list(high) == [15, 20, 26]
    assert list(mean) == [13, 18, 21]
    assert all(map(np.array_equal, band([LINE])[:2], LINE))
    for apart in ([], [NOTHING], [LINE, (np.array([6.0]), np.array([1.0]))]):
        assert [len(part) for part in band(apart)] == [0] * 4


def test_spread():
    assert spread([1.0, None, 3.0]) == (2.0, pytest.approx(2**0.5))
    assert spread([4.0]) == (4.0, None) and spread([None]) == (None, None)


def test_frequency_curves():
    records = [{"event": "step", "iteration": 100, "frequency": None}, {"event": "step"},
               {"event": "eval", "iteration": 200, "frequency": {"paper_mean": 9}},
               {"event": "step", "iteration": 300, "frequency": {"paper_mean": 1, "paper_max": None,
                                                                 "two_words_min": 2}}]
    found = frequency_curves(records)
    assert {variant: list(lines) for variant, lines in found.items()} == {
        "paper": ["mean"], "two_words": ["min"]}
    assert [list(part) for part in found["paper"]["mean"]] == [[300], [1]]


def test_table():
    table = Table("Things", ("name", "size"), [("a<b", "10"), ("long name", "7")], (1,), ("note",))
    assert table.text() == "Things\nname       size\na<b          10\nlong name     7\nnote"
    html = table.html()
    assert "<td>a&lt;b</td><td class=number>10</td>" in html and "<h2>Things</h2>" in html
    assert "<h2>" not in Table("", ("x",), []).html()


class Balanced(HTMLParser):
    """Fails where a tag is not closed or reaches for something outside of the page."""

    def __init__(self, text):
        super().__init__()
        self.open, self.pictures = [], 0
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            assert name not in ("src", "href") or value.startswith("data:"), (tag, value)
        self.pictures += tag == "img"
        assert tag not in ("script", "link", "iframe")
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def headings(html):
    return re.findall("<h2>(.*?)</h2>", html)


def test_the_report_of_a_run(tmp_path):
    run = made_run(tmp_path / "run <1>", "sig")
    path = write_report(run)
    assert path == run.path / "report.html"
    html = path.read_text()
    assert Balanced(html).pictures == 3
    assert headings(html) == ["Held-out views", "Plan", "Growth and loss", "Level changes",
                              "Scene frequency"]
    assert "run &lt;1&gt;: training of city" in html and "10,000 steps" in html
    assert "each level earns its share" in html and "5 → 4" in html and "deadline" in html
    assert write_report(run).read_text() == html  # same records, same bytes


def test_what_a_run_lacks_is_left_out(tmp_path):
    html = write_report(made_run(tmp_path / "constant", "constant")).read_text()
    assert headings(html) == ["Held-out views", "Growth and loss"]
    assert Balanced(html).pictures == 2
    bare = RunFolder.create(tmp_path / "bare")
    bare.write_options({})
    bare.log({"event": "start"})
    assert headings(write_report(bare).read_text()) == []
    bare.log({"event": "level", "iteration": 3})
    bare.log({"event": "eval", "iteration": 3, "psnr": None})
    bare.log({"event": "plan"})
    assert headings(write_report(bare).read_text()) == ["Level changes"]


def test_tables_of_a_run():
    records = list(made_records("sig"))
    levels = level_table(records)
    assert [row[2] for row in levels.rows] == ["5 → 4", "4 → 3", "3 → 2", "2 → 1"]
    assert levels.rows[0][0] == "900" and levels.rows[-1][3] == "deadline"
    assert levels.rows[1][4:7] == ("1,000", "0.00031", "0.0044")
    sparse = [{"event": "step", "level": 3.0}, {"event": "note"}, {"event": "level", "level": 2.0}]
    assert level_table(sparse).rows[0][:4] == ("-", "-", "3 → 2", "-")
    last = score_table(records).rows[-1]
    assert last[0] == "10,000" and float(last[2]) == pytest.approx(float(last[3]) + 0.8, abs=0.011)


def test_a_new_run_removes_the_report_of_the_old(tmp_path):
    run = made_run(tmp_path / "run")
    path = write_report(run)
    RunFolder.create(run.path, overwrite=True).write_options({})
    assert not path.exists()


def test_a_page_escapes_its_words():
    html = page("a & b", "<lead>", picture(Figure(figsize=(1, 1)), 'say "curve"'))
    assert "<title>a &amp; b</title>" in html and "&lt;lead&gt;" in html
    assert 'alt="say &quot;curve&quot;"' in html
