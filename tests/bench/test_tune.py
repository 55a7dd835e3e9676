"""`clsplat bench tune` takes sizes that are faster, and only these; what it writes is used."""

import itertools
import json

import pytest

from clsplat.bench import tune
from clsplat.device import Device
from clsplat.device.tuning import TUNING
from tests.command_line import clsplat_
from tests.data.tiny_training import CITY

WORDS = "bench", "tune", CITY, "-r", 8, "--turns", 3, "--device", "cpu"


def workload(milliseconds):
    """Steps on a device that take what `milliseconds` says of its sizes, turn by turn."""

    def begin(device):
        each = milliseconds(device.tuning)
        return lambda: next(each)

    return begin


def tried(device, milliseconds, turns=8):
    return list(tune.trials(device, workload(milliseconds), turns))


@pytest.fixture
def one_other(monkeypatch):
    """A single size, with one other value."""
    monkeypatch.setattr(tune, "SIZES", {"item_runs": (4, 8), "scan_group": (256,)})


@pytest.fixture
def no_steps(one_other, monkeypatch):
    """And steps that take no time."""
    monkeypatch.setattr(tune, "steps_of", lambda *_, **__: workload(lambda sizes: itertools.repeat(1.0)))


def test_what_is_faster_is_taken_and_measured_again(item_device, monkeypatch):
    """item_runs 8 is faster than all others, of which 4 is not tried again; scan_group makes no
    difference."""
    monkeypatch.setattr(tune, "SIZES", {"item_runs": (8, 2, 4, 16), "scan_group": (64, 256)})
    found = tried(item_device, lambda sizes: itertools.repeat({2: 8.0, 4: 4.0, 8: 2.0, 16: 3.0}[sizes["item_runs"]]))
    assert [(trial.name, trial.new["item_runs"], trial.faster) for trial in found] == [
        ("item_runs", 8, True),
        ("item_runs", 2, False),
        ("item_runs", 16, False),
        ("scan_group", 8, False),
        ("all", 8, True),
    ]
    assert found[-1].old == item_device.tuning
    assert found[-1].new == {**item_device.tuning, "item_runs": 8}
    assert (found[-1].old_ms, found[-1].new_ms, found[-1].quartiles) == (4.0, 2.0, (0.5,) * 3)


@pytest.mark.slow
def test_sizes_of_the_form_are_tried_as_far_as_the_device_allows(item_device):
    device = Device(item_device.handle, form="group")
    found = tried(device, lambda sizes: itertools.repeat(1.0), turns=1)
    assert {trial.name for trial in found} == {"group_size", "scan_group", "tile", "bucket", "adjoint_waves"}
    sizes = {tuple(trial.new.values()) for trial in found}
    assert len(sizes) == len(found) and tuple(device.tuning.values()) not in sizes


@pytest.mark.parametrize(
    "new, faster", [([0.9], True), ([0.99], False), ([1.1], False), ([0.5, 0.5, 1.2], False), ([0.5, 0.6], True)]
)
def test_a_gain_is_more_than_the_spread_and_worth_it(item_device, new, faster):
    sides = iter(([1.0], new))

    def begin(device):
        times = itertools.cycle(next(sides))
        return lambda: next(times)

    trial = tune._compared("item_runs", item_device, item_device, begin, 6)
    assert trial.faster is faster and trial.old_ms == 1.0


def test_what_fails_is_named_and_not_taken(item_device, one_other):
    def milliseconds(sizes):
        if sizes["item_runs"] == 8:
            raise RuntimeError("OUT_OF_\nRESOURCES")
        return itertools.repeat(1.0)

    (trial,) = tried(item_device, milliseconds, turns=1)
    assert trial.line().endswith("4 -> 8        fails: RuntimeError: OUT_OF_ RESOURCES")
    assert not trial.faster


def test_present_sizes_that_fail_are_an_error(item_device, one_other):
    def broken(sizes):
        raise MemoryError

    with pytest.raises(MemoryError):
        tried(item_device, broken)


@pytest.mark.nightly
def test_a_tuning_of_a_real_scene_is_read_back(one_other, monkeypatch, tmp_path):
    monkeypatch.setattr(tune.Trial, "faster", property(lambda trial: bool(trial.old_ms)))
    path = tmp_path / "tuning.json"
    result = clsplat_(*WORDS, "-o", path)
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["size", "item_runs", "all"]
    assert f"{TUNING}={path}" in lines[-1]
    (row,) = json.loads(path.read_text())["rows"]
    assert row["item_runs"] == 8 and row["kind"] == "cpu" and row["local_bytes"] > 0
    monkeypatch.setenv(TUNING, str(path))
    report = clsplat_("devices", "--report").output
    assert "  item runs: 8\n" in report


def test_nothing_is_written_where_nothing_is_faster(no_steps, monkeypatch, tmp_path):
    monkeypatch.setattr(tune.Trial, "faster", False)
    result = clsplat_(*WORDS, "-o", tmp_path / "tuning.json")
    assert result.exit_code == 0 and "nothing is written" in result.output
    assert not list(tmp_path.iterdir())


def test_a_gain_that_does_not_come_again_is_no_gain(no_steps, monkeypatch, tmp_path):
    monkeypatch.setattr(tune.Trial, "faster", property(lambda trial: trial.name != tune.ALL))
    result = clsplat_(*WORDS, "-o", tmp_path / "tuning.json")
    assert "all  " in result.output and "nothing is written" in result.output
    assert not list(tmp_path.iterdir())


def test_without_a_file_the_sizes_are_printed(no_steps, monkeypatch):
    monkeypatch.setattr(tune.Trial, "faster", True)
    assert '"item_runs": 8' in clsplat_(*WORDS).output.splitlines()[-1]


def test_rows_of_other_devices_stay(item_device, monkeypatch, tmp_path):
    monkeypatch.setattr(tune, "check", lambda device: [("sort", True, "")])
    path, sizes = tmp_path / "tuning.json", item_device.tuning
    other = {**item_device.reported, "compute_units": 999, **sizes}
    path.write_text(json.dumps({"rows": [other, {**item_device.reported, **sizes}]}))
    tune.write_row(path, item_device, {**sizes, "item_runs": 16})
    assert tune.read_rows(path) == [{**item_device.reported, **sizes, "item_runs": 16}, other]


def test_sizes_that_fail_the_self_test_are_not_written(no_steps, monkeypatch, tmp_path):
    tested = []
    monkeypatch.setattr(tune.Trial, "faster", True)
    monkeypatch.setattr(
        tune,
        "check",
        lambda device: (
            tested.append(device.tuning)
            or [("sort, item form", True, ""), ("render, item form", False, "relative error 2")]
        ),
    )
    result = clsplat_(*WORDS, "-o", tmp_path / "tuning.json")
    assert result.exit_code == 2 and "render, item form: relative error 2" in result.stderr
    assert result.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
    assert tested[0]["item_runs"] == 8


def test_another_file_is_refused_before_anything_is_measured(monkeypatch, tmp_path):
    monkeypatch.setattr(tune, "steps_of", None)
    path = tmp_path / "letter.txt"
    path.write_text("mine")
    result = clsplat_(*WORDS, "-o", path)
    assert result.exit_code == 2 and str(path) in result.stderr and path.read_text() == "mine"
