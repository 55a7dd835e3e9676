"""The study of cities: what it runs, what it does not repeat, and its tables."""

import json
import re
import subprocess

import pytest

from clsplat.errors import InputError
from tests.data.tiny_training import CITY
from tools.studies import cities

TINY = ["--streets", "1", "2", "--size", "64x48", "--seeds", "1", "--no-compared"]
FLAGS = ["--", "--device", "cpu", "--init", "sfm", "--sh-degree", "0"]


@pytest.mark.nightly
def test_one_command_makes_the_tables_and_repeats_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cities, "STEPS_A_STREET", 10)
    words = [str(tmp_path), f"{CITY}:8", *TINY, *FLAGS, "-n", "20"]
    cities.main(words)
    page = (tmp_path / "cities.md").read_text()
    assert [line[4:] for line in page.splitlines() if line.startswith("### ")] == [
        "As a city grows",
        "Merged against one run",
        "Sig on CityGS and on BlockGS",
    ]
    assert " nan" not in page
    rows = {
        line.split(" | ")[0].strip("| "): line.strip("| ").split(" | ")[1:]
        for line in page.split("### Sig")[0].splitlines()
        if line.startswith("|")
    }
    assert rows["streets, and blocks"] == ["1x1", "2x2"]
    assert re.search(r"` on .+, commit [0-9a-f]{40}", page)
    assert rows["times its area"] == ["1.00", "4.00"]
    mean, least, most = map(float, re.findall(r"[\d.]+", rows["peak memory of a block, MiB: mean (least, most)"][1]))
    assert 0.1 < least <= mean <= most < 50 and least < most  # rounded
    assert rows["the same of interior blocks, which have neighbours on all sides"] == ["-", "-"]
    one, city, ratio, single, merged, difference, *_ = rows["city-r8"]
    assert float(ratio) == pytest.approx(float(city) / float(one), rel=0.05)
    assert float(difference) == pytest.approx(float(merged.split()[0]) - float(single.split()[0]), abs=0.011)
    records = (tmp_path / "cities.jsonl").read_text().splitlines()
    assert len(records) == 3 + 2 + 4 and all(json.loads(line)["seconds"] > 0 for line in records)
    monkeypatch.setattr(subprocess, "run", None)  # nothing is started again
    cities.main(words)
    assert (tmp_path / "cities.md").read_text() == page


@pytest.mark.parametrize(
    "words, cause",
    [
        (["--tables", "area", "one-run", "--no-compared"], "--tables one-run: needs a SCENE"),
        (["--seeds", "0"], "at least 1"),
        (["--streets", "2", "0"], "at least 1"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_starts(tmp_path, monkeypatch, words, cause):
    monkeypatch.setattr(cities, "subprocess", None)
    with pytest.raises(InputError, match=cause):
        cities.main([str(tmp_path), *words])
