"""What the benchmarks print."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.bench import families, measure, run
from clsplat.bench.ceilings import Ceilings
from clsplat.bench.families import IMAGE_FAMILIES
from clsplat.errors import InputError

DEVICE = SimpleNamespace(name="made", form="item",
                         handle=SimpleNamespace(driver_version="1.2", platform=None))
KEYS = {"family", "variant", "form", "device", "driver", "size", "median_ms", "quartiles_ms",
        "repeats", "bytes", "operations", "copy_gb_s", "arithmetic_gop_s", "copy_share",
        "arithmetic_share"}


@pytest.fixture
def bench(monkeypatch):
    """A Bench of a device that copies 8 GB and does 100 G operations a second."""
    monkeypatch.setattr(measure, "choose_device", lambda spec, **options: DEVICE)
    monkeypatch.setattr(measure, "measure_ceilings", lambda device: Ceilings(8e9, 1e11))
    return lambda *argv: measure.Bench(argv, "made")


def test_a_line_has_medians_quartiles_and_shares(bench, capsys):
    times = np.array([1.0, 2.0, 3.0, 4.0, 9.0])
    bench("--json").report("blend", "forward", times, {"pairs": 7}, 6_000_000, 30_000_000)
    record = json.loads(capsys.readouterr().out)
    assert record.keys() == KEYS
    assert (record["median_ms"], record["quartiles_ms"], record["repeats"]) == (3, [2, 4], 5)
    assert (record["copy_share"], record["arithmetic_share"]) == (0.25, 0.1)
    assert record["size"] == {"pairs": 7}


def test_what_is_not_counted_has_no_share(bench, capsys):
    bench("--json").report("step", "caliterra", np.ones(3), {})
    record = json.loads(capsys.readouterr().out)
    assert record["bytes"] is record["copy_share"] is record["arithmetic_share"] is None


def test_a_table_begins_with_the_ceilings(bench, capsys):
    bench().report("blend", "forward", np.full(3, 2.0), {"pairs": 7000}, 8_000_000, 0)
    head, row = capsys.readouterr().out.splitlines()
    assert "8.0 GB/s" in head and "100.0 Gop/s" in head
    assert "2.000 ms" in row and "pairs 7,000" in row and "4.0 GB/s (50%)" in row


@pytest.mark.parametrize("text, expected", [
    ("200k,1M,4M", (200_000, 1_000_000, 4_000_000)), ("2.5k", (2500,)), ("0,17", (0, 17))])
def test_counts(text, expected):
    assert measure.counts(text) == expected


@pytest.mark.parametrize("text", ["", "1M,", "many", "-3", "1kk"])
def test_a_bad_count_is_told(text):
    with pytest.raises(InputError, match=f"'{text}' is not a list of counts such as 200k,1M,4M"):
        measure.arguments([f"--gaussians={text}"], "made", gaussians="200k")


@pytest.mark.slow
@pytest.mark.parametrize("family", families())
def test_each_family_prints_its_lines(family, monkeypatch, capsys):
    monkeypatch.setattr(measure, "measure_ceilings", lambda device: Ceilings(1e15, 1e18))
    more = ["--gaussians", "2k"]
    if family == "step":
        more = ["--scene", "data_samples/city", "--downscale", "4", "--gaussians", "0"]
    elif family in IMAGE_FAMILIES:
        more = ["--size", "80", "64"]
    run(family, ["--json", "--repeats", "2", *more])
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert records and all(record.keys() == KEYS for record in records)
    whole = family in ("render", "statistics", "step")  # of these no bytes are counted
    assert all((record["bytes"] is None) == (whole or record["variant"].startswith("numpy"))
               and record["median_ms"] > 0 and record["family"] == family for record in records)


@pytest.mark.parametrize("words", [["--repeats", "x"], ["--nothing"]])
def test_wrong_words_are_one_line(words):
    with pytest.raises(InputError, match=f"{words[0]}.*clsplat bench FAMILY -- --help"):
        measure.arguments(words, "what it measures", gaussians="200k")
