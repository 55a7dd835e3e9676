"""Evidence: its pages are those of its results, and each measured default has its line."""

import json
import re

import pytest

from clsplat.config.option import options_of
from clsplat.options import TrainOptions
from clsplat.partition.options import PartitionOptions
from clsplat.report.page import Table
from tools import evidence
from tools.studies import study

OPTIONS = {option.name: option for kind in (TrainOptions, PartitionOptions) for option in options_of(kind)}
DEFAULTS = evidence.records(evidence.RESULTS / "defaults.jsonl")


def test_the_pages_are_made_of_the_results():
    there = {path: path.read_text("utf-8") for path in evidence.PAGES.glob("*.md")}
    assert there == evidence.pages(), "run python -m tools.evidence"


def test_every_measured_default_has_a_line_and_no_other_has():
    measured = [name for name, option in OPTIONS.items() if option.metadata["measured"]]
    assert sorted(line["option"] for line in DEFAULTS) == sorted(measured)


@pytest.mark.parametrize("line", DEFAULTS, ids=lambda line: line["option"])
def test_the_evidence_is_of_today_s_default(line):
    """Whoever changes a default measures it again, or takes its line away."""
    assert json.loads(json.dumps(OPTIONS[line["option"]].default)) == line["value"]
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", line["date"]) and line["command"]
    assert re.fullmatch(r"[0-9a-f]{7,40}", line["commit"])
    name, _, heading = line["see"].partition("#")
    page = (evidence.PAGES / name).read_text("utf-8")
    headings = re.findall(r"(?m)^## (.+)$", page)
    assert heading in [re.sub(r"[^\w-]", "", text.lower().replace(" ", "-")) for text in headings]


def test_every_table_says_when_and_how_it_was_measured():
    tables = [line for path in evidence.files() for line in evidence.records(path) if "table" in line]
    assert len(tables) > 30
    for table in tables:
        assert re.match(r"20\d\d-\d\d-\d\d", table["date"]), table
        assert table["commit"] and table["command"] and table["source"], table


@pytest.mark.parametrize(
    "value, text",
    [
        (12345, "12,345"),
        ([36.4, 35.53], "36.40 / 35.53"),
        (True, "on"),
        ([], "auto"),
        (None, ""),
        (3.9e-7, "3.9e-07"),
        ("a|b", "a/b"),
    ],
)
def test_a_cell(value, text):
    assert evidence.text_of(value, 2) == text


def test_a_study_replaces_its_table_and_leaves_the_others(tmp_path, monkeypatch):
    for name, folder in (("RESULTS", study), ("RESULTS", evidence)):
        monkeypatch.setattr(folder, name, tmp_path)
    lines = [{"page": "P", "about": "A."}, {"table": "one"}, {"x": 1}, {"table": "two"}, {"x": 2}]
    (tmp_path / "p.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    study.keep("p", [Table("one", ("x",), [("3",), ("4",)], (0,), ("Note.",))], "clsplat x", "cpu")
    kept = evidence.records(tmp_path / "p.jsonl")
    assert kept[0] == lines[0] and kept[2:4] == [{"x": "3"}, {"x": "4"}] and kept[4:] == lines[3:]
    assert kept[1]["text"] == "Note." and kept[1]["command"] == "clsplat x"


def test_a_column_has_one_number_of_digits():
    assert evidence.table([{"x": "a", "y": 0.5}, {"x": "b", "y": 1.25}]) == (
        "| x | y |\n| --- | ---: |\n| a | 0.50 |\n| b | 1.25 |"
    )
