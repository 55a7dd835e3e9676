"""Sizes of kernels come from our table, or from the file that CLSPLAT_TUNING names."""

import itertools
import json

import pytest

from clsplat.bench.selftest import check
from clsplat.device import Device, device
from clsplat.device.tuning import SIZES, TUNING, tuning_of
from tests.command_line import clsplat_
from tests.data.tiny_training import CITY
from tests.refusals import refused

ROW = {
    "kind": "cpu",
    "wave": 32,
    "item_runs": 8,
    "group_size": 64,
    "scan_group": 128,
    "tile": 8,
    "bucket": 32,
    "adjoint_waves": 2,
}


@pytest.fixture
def tuned(tmp_path, monkeypatch):
    """tuned(text or rows): the path of a file with these, which CLSPLAT_TUNING names."""

    def write(content):
        path = tmp_path / "tuning.json"
        text = content if isinstance(content, str) else json.dumps({"rows": content})
        path.write_text(text, encoding="utf-8")
        monkeypatch.setenv(TUNING, str(path))
        return path

    return write


def opened(entry, form):
    made = Device(entry.handle, form=form)
    return {
        name: getattr(made, name)
        for name in ("item_runs", "group_size", "scan_group", "tile", "bucket", "adjoint_group")
    }


@pytest.mark.parametrize("form, tile", [("item", 16), ("group", 8)])
def test_a_file_changes_the_sizes_of_a_device(tuned, item_device, form, tile):
    tuned([ROW])
    assert opened(item_device, form) == {
        "item_runs": 8,
        "group_size": 64,
        "scan_group": 128,
        "tile": tile,
        "bucket": 32,
        "adjoint_group": 64,
    }


def test_only_devices_that_report_what_a_row_asks_for_get_it(tuned, item_device):
    ours, reported = tuning_of(**item_device.reported), item_device.reported
    assert reported["compute_units"] > 0 < reported["local_bytes"]
    sizes = {name: ROW[name] for name in SIZES}
    tuned([{**reported, **sizes}])
    assert tuning_of(**reported) == sizes != ours
    for name, other in {"kind": "gpu", "wave": 64, "compute_units": 4097, "local_bytes": 12345}.items():
        tuned([{**reported, name: other, **sizes}])
        assert tuning_of(**reported) == ours, name
    tuned([{**ROW, "kind": "gpu"}, ROW, {**ROW, "item_runs": 2}])
    assert tuning_of(**reported) == sizes, "the first one that fits"


def test_every_device_has_a_row_of_ours(monkeypatch):
    monkeypatch.delenv(TUNING, raising=False)
    for kind, wave in itertools.product(("cpu", "gpu"), (32, 64)):
        assert tuning_of(kind, wave).keys() == SIZES.keys()
    assert tuning_of("gpu", 64) != tuning_of("gpu", 32)


LACKS = {name: size for name, size in ROW.items() if name != "bucket"}
DAMAGED = {
    "": "not a JSON object",
    "{": "not a JSON object",
    "[]": "not a JSON object",
    "{}": "not a JSON object",
    '{"rows": 7}': "not a JSON object",
    "[" * 100_000: "not a JSON",
    '{"rows": [7]}': "row 1 is not an object",
}
FAULTS = [
    (LACKS, "row 2 lacks bucket"),
    ({**ROW, "tile": 12}, "has tile 12, which is none of 8, 16"),
    ({**ROW, "bukcet": 64}, 'has the unknown key "bukcet"'),
    ({**ROW, "a\nb": 1}, '"a\\nb"'),
    ({**ROW, "group_size": 512}, "is none of 32, 64, 128, 256"),  # Adam's local arrays end before
    ({**ROW, "tile": 16.0}, "tile 16.0"),
    ({**ROW, "tile": "16"}, 'tile "16"'),
    ({**ROW, "item_runs": True}, "item_runs true"),
    ({**ROW, "bucket": None}, "bucket null"),
    ({**ROW, "bucket": [64]}, "bucket [64]"),
    ({**ROW, "kind": "tpu"}, "none of cpu, gpu"),
    ({**ROW, "compute_units": 0}, "compute_units 0, which is not a whole number above 0"),
    ({**ROW, "local_bytes": "x"}, 'local_bytes "x"'),
]


@pytest.mark.parametrize("text, message", DAMAGED.items(), ids=lambda text: text[:9])
def test_a_file_that_is_no_table_is_refused(tuned, text, message):
    path = tuned(text)
    assert refused(lambda: tuning_of("cpu", 32), message, TUNING).startswith(f"{path}: ")


@pytest.mark.parametrize("row, message", FAULTS, ids=[fault[1] for fault in FAULTS])
def test_a_row_that_is_not_legal_is_refused(tuned, row, message):
    path = tuned([ROW, row])  # also where another one fits
    assert refused(lambda: tuning_of("cpu", 32), message, "bench tune").startswith(f"{path}: row 2")


@pytest.mark.parametrize("words", [("devices",), ("bench", CITY), ("bench tune", CITY)])
def test_a_command_ends_with_one_line(tuned, words):
    path = tuned([LACKS])
    for _ in ("damaged", "missing"):
        result = clsplat_(*words)
        assert result.exit_code == 2 and result.stderr.startswith(f"error: {path}: ")
        assert result.stderr.count("\n") == 1
        path.unlink(missing_ok=True)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name, value, wave",
    [
        (name, value, wave)
        for name, values in SIZES.items()
        for value in values
        for wave in ((32, 64) if name in ("tile", "bucket", "adjoint_waves") else (32,))
        if value != tuning_of("gpu", wave)[name]
    ],
)
def test_the_self_test_passes_with_each_size(item_device, monkeypatch, name, value, wave):
    monkeypatch.setattr(device, "probe_wave", lambda *_: wave)
    made = Device(item_device.handle, tuning={**tuning_of("gpu", wave), name: value})
    assert [line for line in check(made) if not line[1]] == []
