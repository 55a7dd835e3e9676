"""What the benchmarks print."""

import json

import pytest
from click.testing import CliRunner

from clsplat.bench import families
from clsplat.bench.measure import counts
from clsplat.cli.main import main

KEYS = {"family", "variant", "form", "device", "driver", "size", "median_ms", "quartiles_ms",
        "repeats"}


def bench(*words):
    return CliRunner().invoke(main, ["bench", *words])


def test_without_a_family_all_are_listed():
    listed = bench().output.split()
    assert listed == families() and {"blend", "render", "step"} <= set(listed)


@pytest.mark.parametrize("text, expected", [
    ("200k,1M,4M", (200_000, 1_000_000, 4_000_000)), ("2.5k", (2500,)), ("0,17", (0, 17))])
def test_counts(text, expected):
    assert counts(text) == expected


@pytest.mark.parametrize("words, said", [
    (["--gaussians", "1M,"], "1M, is not a list of counts"), (["--gaussians", ""], "list of"),
    (["--gaussians", "-3"], "-3 is not a list"), (["--repeats", "x"], "--repeats"),
    (["--scene", "town"], "--scene: is for `clsplat bench step` only"),
    (["--profile"], "--profile: is for")])
def test_wrong_words_are_one_line(words, said):
    result = bench("blend", *words)
    assert result.exit_code == 2 and said in result.output.splitlines()[-1]
    assert bench("nothing").output.startswith("error: unknown benchmark 'nothing'; known: adam,")


@pytest.mark.slow
@pytest.mark.parametrize("family", families())
def test_each_family_prints_its_lines(family):
    more = ["--gaussians", "2k"]
    if family == "step":
        more = ["--scene", "data_samples/city", "--downscale", "4", "--gaussians", "0", "--profile"]
    result = bench(family, "--json", "--repeats", "2", "--device", "cpu", *more)
    assert result.exit_code == 0, result.output
    records = [json.loads(line) for line in result.output.splitlines()]
    assert records and all(record.keys() == KEYS and record["median_ms"] > 0
                           and record["family"] == family for record in records)


@pytest.mark.slow
def test_a_table_has_medians_and_quartiles():
    row, = bench("cull", "--gaussians", "2k", "--repeats", "2", "--device", "cpu"
                 ).output.splitlines()
    assert row.startswith("cull") and " ms  (" in row and "gaussians 2,000" in row
