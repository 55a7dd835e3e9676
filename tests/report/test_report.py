"""The page of a run, tables; parts that a run lacks are left out."""

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from clsplat.io.runs.city import StageTime
from clsplat.io.runs.run import RunFolder
from clsplat.report import run as run_page
from clsplat.report import scores
from clsplat.report.charts import Line, _panel, drawn, score_chart, step_chart
from clsplat.report.city import LONGEST_PAUSE, time_line
from clsplat.report.page import Table, full_name, page
from clsplat.report.run import lead, level_table, write_report
from tests.apps.browser import answer_of, needs_chromium
from tests.command_line import clsplat_
from tests.data.made_runs import made_records, made_run


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
        self.open, self.charts, self.pictures = [], 0, 0
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            assert name not in ("src", "srcset", "href") or value.startswith("data:"), (tag, value)
        self.charts += str(dict(attributes).get("class")).startswith("chart")
        self.pictures += tag == "img"
        assert tag not in ("link", "iframe")
        if tag not in ("br", "img", "meta", "source"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def headings(html):
    return re.findall("<h2>(.*?)</h2>", html)


def bare_run(folder):
    """A RunFolder whose page has no figures."""
    run = RunFolder.create(folder)
    run.write_options({})
    run.log({"event": "start"})
    return run


def test_the_report_of_a_run(tmp_path):
    run = made_run(tmp_path / "run <1>", "sig")
    path = write_report(run)
    assert path == run.path / "report.html"
    html = path.read_text()
    assert Balanced(html).charts == 2
    assert headings(html) == ["Scores over training time", "Growth and loss", "Plan", "Level changes"]
    assert "<h1>city: run &lt;1&gt;</h1>" in html and "(10,000 steps)" in html
    assert "each level earns its share" in html and "deadline" in html


@pytest.mark.slow
def test_what_a_run_lacks_is_left_out(tmp_path):
    html = write_report(made_run(tmp_path / "constant", "constant")).read_text()
    assert headings(html) == ["Scores over training time", "Growth and loss"]
    assert Balanced(html).charts == 2
    bare = bare_run(tmp_path / "bare")
    assert headings(write_report(bare).read_text()) == []
    bare.log({"event": "level", "iteration": 3})
    bare.log({"event": "eval", "iteration": 3, "psnr": None})
    bare.log({"event": "plan"})
    assert headings(write_report(bare).read_text()) == ["Scores", "Level changes"]


def test_a_single_evaluation_has_a_table_and_no_curve(tmp_path):
    records = list(made_records("constant"))
    once = [r for r in records if r["event"] != "eval"] + [r for r in records if r["event"] == "eval"][-1:]
    assert score_chart(records) and score_chart(once) is None
    assert step_chart(once) and step_chart(once[:1]) is None
    run = RunFolder.create(tmp_path / "once")
    run.write_options({"schedule": "constant"})
    for record in once:
        run.log(record)
    html = write_report(run).read_text()
    assert Balanced(html).charts == 1 and "PSNR cc, dB" in html


def test_the_lead_says_what_was_trained():
    options = {"opencl_device": "H100", "schedule": "dash", "seed": 3}
    records = [
        {
            "event": "eval",
            "iteration": 900,
            "train_seconds": 200.4,
            "gaussians": 12345,
            "psnr_cc": 24.5,
            "psnr": 23.25,
            "views": 1,
        }
    ]
    assert lead(options, records) == (
        "A model of 12,345 gaussians, trained in 3 min 20 s (900 steps) on H100. PSNR on 1 "
        "held-out view: 23.25 dB (fair), after the colour fit 24.50 dB. Schedule dash, seed 3."
    )
    records[0]["exposure_weight"] = 0.25
    assert (
        "PSNR on 1 held-out view, after the colour fit: 24.50 dB (fair). Exposure of held-out views: 25% interpolated"
    ) in lead(options, records)
    assert "1 h 40 min" in lead(options, [{"train_seconds": 6012}])
    assert "PSNR" not in lead(options, [{"train_seconds": 1}])
    city = [{"event": "merge"}, {"train_seconds": 6012, "iteration": 7}]
    assert "trained in 1 h 40 min, the sum of its blocks (7 steps) on" in lead(options, city)
    assert "has no records" in lead({}, [])


def test_a_figure_that_fails_is_a_line(tmp_path, monkeypatch):
    def fails(records):
        raise RuntimeError("no <font>\nmore of it")

    monkeypatch.setattr(run_page, "step_chart", fails)
    html = write_report(made_run(tmp_path / "run")).read_text()
    assert "could not be drawn (no &lt;font&gt;)" in html and "Level changes" in html
    assert Balanced(html).charts == 1


def test_tables_of_a_run():
    records = list(made_records("sig"))
    levels = level_table(records)
    assert [row[2] for row in levels.rows] == ["4", "3", "2", "1"]
    assert levels.rows[0][0] == "900" and levels.rows[-1][-1] == "deadline"
    assert level_table([{"event": "level", "level": 2.0}]).rows == [("-", "-", "2", "-", "-")]
    last = scores.score_table(records).rows[-1]
    assert last[0] == "10,000" and float(last[2]) == pytest.approx(float(last[3]) + 0.8, abs=0.011)


LEVEL, GROW = {"event": "level"}, {"event": "grow", "cloned": 3, "split": 0}


def evaluations(*steps):
    """Records of evaluations with their (step, PSNR), and of what happened at other steps."""
    return [
        {
            "iteration": at,
            "train_seconds": float(at),
            **({"event": "eval", "psnr": what} if isinstance(what, float) else what),
        }
        for at, what in steps
    ]


@pytest.mark.parametrize(
    "steps, words",
    [
        (((110, {"event": "reset"}),), "opacities just lowered"),
        (((99, {"event": "reset"}),), ""),
        (((170, GROW),), "gaussians just added"),
        (((170, {"event": "grow", "pruned": 9}),), ""),
        (((165, GROW), (170, LEVEL)), "photos just became larger"),
        ((), ""),
    ],
)
def test_what_lowers_the_scores_is_named_and_marked(steps, words):
    records = evaluations((100, 20.0), *steps, (200, 18.0))
    upheavals = {r["event"]: r["iteration"] for r in records if scores.is_upheaval(r)}
    assert scores.disturbed(upheavals, 200) == words
    assert sum(map(len, score_chart(records)["marks"].values())) == len(upheavals)


@pytest.mark.parametrize(
    "psnr, shown",
    [
        (28.0, "28.00 dB (very good)"),
        (27.99, "27.99 dB (good)"),
        (22.0, "22.00 dB (fair)"),
        (3.0, "3.00 dB (poor)"),
        (-2.0, "-2.00 dB (poor)"),
        (float("inf"), "inf dB (very good)"),
        (float("nan"), "unknown"),
        (None, "unknown"),
    ],
)
def test_a_number_and_a_word(psnr, shown):
    assert scores.with_quality(psnr) == shown


@pytest.mark.parametrize(
    "scene, run, title",
    [
        ("run", "run", "run"),
        ("cal_scene", "cal", "cal"),
        ("", "cal", "cal"),
        (None, "cal", "cal"),
        ("../photos/dunes", "run", "dunes: run"),
        ("city.npz", "out/city_run", "city_run"),
    ],
)
def test_a_run_is_called_by_scene_and_run_but_not_twice(scene, run, title, tmp_path):
    assert full_name(tmp_path / run, {"scene": scene}) == title


@pytest.mark.parametrize(
    "made, line",
    [
        (
            {
                "date": "2026-11-27T19:20:01+01:00",
                "version": "0.1.0",
                "commit": "f3a1525" * 6,
                "command": "clsplat train 'a <b>'",
            },
            "2026-11-27 19:20 · clsplat 0.1.0 (f3a1525f) · <code>clsplat train &#x27;a &lt;b&gt;&#x27;</code>",
        ),
        ({"version": "0.1.0", "commit": None}, "clsplat 0.1.0"),  # of an older run
        ({"date": 7, "command": ["x"]}, "7 · <code>[&#x27;x&#x27;]</code>"),  # edited by hand
        ({}, None),
    ],
)
def test_the_head_says_when_by_what_and_how(made, line):
    html = page("title", "lead", made=made)
    assert f"<p class=facts>{line}</p>" in html if line else "class=facts" not in html
    Balanced(html)


NAMED = {
    "x": "x </script>",
    "marks": {},
    "panels": [_panel("<b>", [Line("</script><b>", (np.array([1.0, 2.0]), np.array([3.0, np.nan])))])],
}


def test_a_page_escapes_its_words():
    html = page("a & b", "<lead>", drawn('say "curve"', lambda: NAMED))
    assert "<title>a &amp; b</title>" in html and "&lt;lead&gt;" in html
    assert 'aria-label="say &quot;curve&quot;"' in html and Balanced(html).charts == 1
    assert "[3.0, null]" in html and "</script><b>" not in html
    assert "uPlot" not in page("none", "")


def test_lines_of_a_panel_share_their_places():
    line = (np.array([1.0, 3.0]), np.array([5.0, 6.1234567]))
    lines = [Line("a", line), Line("b", (np.array([2.0]), np.array([7.0])), kind="band", high=np.array([8.0]))]
    assert _panel("p", lines)["data"] == [[1, 2, 3], [5, None, 6.12346], [None, 7, None], [None, 8, None]]


def test_of_two_points_at_one_place_the_last_is_drawn():
    records = evaluations((100, 20.0), (200, 21.0), (200, 22.0))
    assert score_chart(records)["panels"][0]["data"][2] == [20, 22]


EVERY = ("step", "grow", "level", "reset", "eval", "plan", "warning")
# name -> (options, records, words that the page has)
HOSTILE = {
    "markup in a plan": (
        {},
        [{"event": "plan", "iteration": 0, "reasons": {"<b>": "x & y"}}],
        ("&lt;b&gt;", "x &amp; y"),
    ),
    "markup in names": (
        {"scene": "/data/<script>x</script>", "schedule": "<i>"},
        [{"event": "step", "iteration": 100}],
        ("Schedule &lt;i&gt;",),
    ),
    "exposures without a fitted score": (
        {},
        [{"event": "eval", "psnr": 20.0, "exposure_weight": 0.5}],
        ("A model of 0",),
    ),
    "nulls everywhere": (
        {},
        [
            {
                "event": event,
                "iteration": None,
                "train_seconds": None,
                "level": None,
                "gaussians": None,
                "loss": None,
                "psnr": None,
            }
            for event in EVERY
        ],
        ("A model of 0",),
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_any_run_has_a_page(name, tmp_path):
    options, records, words = HOSTILE[name]
    run = RunFolder.create(tmp_path / "run")
    run.write_options({"scene": "/data/city", **options})
    for record in records:
        run.log(record)
    html = write_report(run).read_text("utf-8")
    Balanced(html)
    assert all(word in html for word in words), html[-4000:]
    assert "could not be" not in html and "<script>x" not in html
    assert not re.search(r"\b(nan|inf)\b", html)


@pytest.mark.parametrize(
    "command, damage, words",
    [
        ("eval", lambda run: (run.path / "options.json").write_text("{"), "options.json: damaged"),
        ("compare", lambda run: (run.path / "metrics.jsonl").write_text("[1]\n"), "line 1 is damaged"),
        ("compare", lambda run: (run.path / "compare.html").mkdir(), "compare.html: cannot be"),
    ],
)
def test_a_damaged_run_is_refused_in_one_line(command, damage, words, tmp_path):
    run = made_run(tmp_path / "run")
    damage(run)
    done = clsplat_(command, run.path)
    last = done.output.strip().splitlines()[-1]
    assert done.exit_code == 2 and last.startswith("error: ") and words in last


@needs_chromium
@pytest.mark.slow
def test_the_browser_draws_every_panel(tmp_path):
    page = write_report(made_run(tmp_path / "run", "sig")).read_text()
    answer = answer_of(
        tmp_path,
        page,
        """
        const of = (selector) => [...page.document.querySelectorAll(selector)];
        await until(() => of(".u-wrap canvas").length == 5);
        await new Promise((wake) => setTimeout(wake, 300));
        const inked = of(".u-wrap canvas").map((canvas) => {
          const {data} = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
          let count = 0;  // of pixels in the colour of the first line
          for (let i = 0; i < data.length; i += 4)
            count += data[i] < 40 && Math.abs(data[i + 1] - 114) < 30 && data[i + 2] > 150;
          return count > 100;
        });
        const over = of(".u-over")[0], {left, top, width} = over.getBoundingClientRect();
        over.dispatchEvent(new page.MouseEvent("mousemove", {
          bubbles: true, clientX: left + width - 2, clientY: top + 50}));
        await new Promise((wake) => setTimeout(wake, 300));
        return JSON.stringify([inked, of(".u-value").slice(0, 2).map((at) => at.textContent)]);
    """,
        (900, 1200),
    )
    inked, values = json.loads(answer)
    assert inked == [True] * 5
    last = [r for r in made_records("sig") if r["event"] == "eval"][-1]
    assert float(values[1]) == pytest.approx(last["psnr_cc"], abs=0.01)


def test_stages_of_a_city_are_shown_when_and_where_they_were_done():
    assert time_line([]) == ""
    stages = [
        StageTime(*each)
        for each in (
            ("coarse <run>", "here", 1000.0, 10.0),
            ("000", "here, 0", 1010.0, 20.0),
            ("001", "here, 0", 1015.0, 5.0),
            ("002", "here, 0", 1020.0, 15.0),
            ("merge", "here", 5030.0, 5.0),
        )
    ]  # by a later command
    html = time_line(stages)
    bars = re.findall(r"<i style=\"left: ([\d.]+)%; width: ([\d.]+)%\" title=\"([^:]*):", html)
    found = {name: (float(left) / 2, float(width) / 2) for left, width, name in bars}  # of 50 s
    pause = LONGEST_PAUSE
    assert found == {
        "coarse &lt;run&gt;": (0, 10),
        "000": (10, 20),
        "001": (15, 5),
        "002": (20, 15),
        "merge": (35 + pause, 5),
    }
    assert "in 50 seconds" in html and html.count("<tr>") == 3  # two side by side
    assert html.count("here, 0") == 1
