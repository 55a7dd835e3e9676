"""What the benchmarks print, and the pages made of it."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.bench import __main__ as entry
from clsplat.bench import measure, numerics, precision
from clsplat.bench.ceilings import Ceilings
from clsplat.bench.variants import KNOBS, VARIANTS
from clsplat.errors import InputError

DEVICE = SimpleNamespace(name="made", form="item",
                         handle=SimpleNamespace(driver_version="1.2", platform=None))
KEYS = {"family", "variant", "form", "device", "driver", "size", "median_ms", "quartiles_ms",
        "repeats", "bytes", "operations", "copy_gb_s", "arithmetic_gop_s", "copy_share",
        "arithmetic_share"}
FIELDS = ("positions", "opacity_logits")


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
@pytest.mark.parametrize("family", ["adam", "batch", "bin", "blend", "compact", "contribution",
                                    "cull", "exposure", "frequency", "gather", "image_loss",
                                    "noise", "pose", "project", "reduce", "regularise", "render",
                                    "reproject", "sort", "statistics", "step", "sweep"])
def test_each_family_prints_its_lines(family, monkeypatch, capsys):
    monkeypatch.setattr(measure, "measure_ceilings", lambda device: Ceilings(1e15, 1e18))
    more = ["--scene", "data_samples/city", "--downscale", "4"] if family == "step" else []
    sized = family in ("exposure", "image_loss", "reproject", "sweep")
    more += [] if sized else ["--gaussians", "0" if family == "step" else "2k"]
    assert entry.main([family, "--json", "--repeats", "2", *more]) == 0
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert records and all(record.keys() == KEYS for record in records)
    whole = family in ("render", "statistics", "step")  # of these no bytes are counted
    assert all((record["bytes"] is None) == (whole or record["variant"].startswith("numpy"))
               and record["median_ms"] > 0 and record["family"] == family for record in records)


def test_errors_are_relative_and_name_the_worst():
    image = np.zeros((3, 1, 2))
    reference = {"image": image, "gradients": {"positions": np.array([[3.0, 4.0], [0, 0]])}}
    off = {"image": image + [[[0, 0.5]]],
           "gradients": {"positions": np.array([[3.0, 4.0], [0, 2.0]])}}
    difference = precision.errors(off, reference)
    assert [difference[f"image_{name}"] for name in ("max", "mean", "above")] == [0.5, 0.25, 0.5]
    assert difference["gradients"]["positions"] == {
        "l2": 0.4, "worst": 0.5, "element": "positions[1, 1]"}


def made_records(device="made", fast=None, usual=10.0):
    """A record a variant; each takes `usual` ms and is as exact as the default, `fast` half."""
    for variant in VARIANTS:
        error = {"image_max": 0.01, "image_mean": 1e-4, "image_above": 0.1, "gradients": {
            name: {"l2": 1e-3, "worst": 2e-3, "element": f"{name}[4]"} for name in FIELDS}}
        time = usual / 2 if variant.name == fast else usual
        times = {"median_ms": time, "quartiles_ms": [time, time]} if variant.is_timed else {}
        yield {"knob": variant.knob, "variant": variant.name, "form": "item", "device": device,
               "platform": "Made Platform", "driver": "1.2", "command": "python -m made",
               "size": {"gaussians": 2000, "width": 32, "height": 16, "skipped": 0}, **times,
               **{kind: error for kind in numerics.KINDS}}


def test_every_knob_has_a_reason_and_each_variant_a_row():
    text = numerics.markdown(list(made_records()))
    assert numerics.REASONS.keys() == KNOBS.keys()
    for knob, (default, _) in KNOBS.items():
        assert f"## {knob.capitalize()}\n\nDefault: {default}. {numerics.REASONS[knob]}" in text
        assert f"| {default} (default) | Made item 2k | 10.0 | 1.00 |" in text
    for variant in VARIANTS[1:]:
        cells = "10.0 | 1.00" if variant.is_timed else " | "
        assert f"| {variant.name} | Made item 2k | {cells} | 1.0e-02 | 1.0e-04 |" in text
    assert "faster: " not in text and "python -m made" in text


def test_a_better_variant_is_named():
    text = numerics.markdown(list(made_records(fast="exp")))
    assert "no worse and faster: exp on Made item 2k (0.50 of the time)." in text
    assert text.count("no worse and faster: ") == 1


@pytest.mark.slow
def test_pages_of_the_records_of_several_machines(tmp_path):
    for name, usual in (("one", 10.0), ("two", 40.0)):
        (tmp_path / name).write_text(
            "".join(json.dumps(record) + "\n" for record in made_records(name, usual=usual)))
    precision.main(["--records", str(tmp_path / "one"), str(tmp_path / "two"),
                    "--html", str(tmp_path / "page.html"), "--markdown", str(tmp_path / "page.md")])
    page, text = (tmp_path / "page.html").read_text(), (tmp_path / "page.md").read_text()
    assert page.count("<picture>") == 1 and page.count("data:image/svg+xml") == 2
    assert "<script" not in page
    assert "<h2>Exponential</h2>" in page and text.count("| Made item 2k | one |") == 1
    assert text.count("| Made item 2k | two |") == 1
    assert "| exp | Made item 2k | 40.0 | 1.00 |" in text  # beside its own machine's default


@pytest.mark.parametrize("words", [["--repeats", "x"], ["--nothing"]])
def test_wrong_words_are_one_line(words):
    with pytest.raises(InputError, match=f"{words[0]}.*clsplat bench FAMILY -- --help"):
        measure.arguments(words, "what it measures", gaussians="200k")
