"""Benchmarks: what `clsplat bench` and `python -m tools.bench` print."""

import json

import pytest
from click.testing import CliRunner

from clsplat.cli.main import main
from tests.data.tiny_training import CITY
from tools.bench.__main__ import main as tool
from tools.bench.families import FAMILIES
from tools.bench.report import counts

KEYS = {"family", "variant", "form", "device", "driver", "size", "median_ms", "quartiles_ms", "repeats"}


@pytest.mark.parametrize(
    "text, expected", [("200k,1M,4M", (200_000, 1_000_000, 4_000_000)), ("2.5k", (2500,)), ("0,17", (0, 17))]
)
def test_counts(text, expected):
    assert counts(text) == expected
    with pytest.raises(ValueError, match="not a list"):
        counts(text + ",")


@pytest.mark.slow
@pytest.mark.parametrize("family", ["render", *FAMILIES])
@pytest.mark.one_in(7)
def test_each_family_prints_its_lines(family, capsys):
    tool([family, "--json", "--repeats", "2", "--device", "cpu", "--gaussians", "2k"])
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert records and all(
        record.keys() == KEYS and record["median_ms"] > 0 and record["family"] == family for record in records
    )


@pytest.mark.slow
def test_a_step_is_timed():
    words = ["bench", str(CITY), "-r", "8", "--device", "cpu", "--profile"]
    record = json.loads(CliRunner().invoke(main, [*words, "--json"]).output)
    assert record["median_ms"] > 0 < record["kernels_ms"]["blend_adjoint"]
    assert record["waits"] == pytest.approx(0) and record["launches"] > 10
    shown = CliRunner().invoke(main, words).output
    assert "median_ms" in shown and "  blend_adjoint" in shown
