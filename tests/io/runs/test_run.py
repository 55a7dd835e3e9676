"""A run folder loses no data, and names the file that somebody else damaged."""

import json
import os
import signal
import zipfile
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.npz import read_npz, state_array, write_npz
from clsplat.io.runs.city import BlockFolder, CityFolder
from clsplat.io.runs.run import RunFolder
from tests.refusals import refused

ARRAYS = {
    "positions": np.arange(12, dtype=np.float32).reshape(4, 3),
    "adam/first": np.full((4, 3), np.pi),
    "count": np.array(7, np.uint32),
    "empty": np.zeros((0, 15, 3), np.float32),
}
STATE = {"iteration": 500, "random": {"state": 2**127 + 1}, "best": 0.1, "level": None}


@pytest.fixture
def run(tmp_path):
    return RunFolder.create(tmp_path / "out" / "run")


def same(loaded):
    arrays, state = loaded
    assert state == {**STATE, "format": 1} and list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype and np.array_equal(arrays[name], array)


def test_create_open_overwrite(run):
    refused(lambda: RunFolder.open(run.path), "run", "holds no run")
    (run.path / "mine.txt").write_text("keep")
    RunFolder.create(run.path)  # a folder without a run is fine
    run.write_options({})
    run.log({"iteration": 1})
    run.save_checkpoint(ARRAYS, STATE)
    run.save_model(Gaussians.from_points(np.eye(3), np.zeros((3, 3), np.uint8), 0), np.zeros(3))
    run.picture("a/b.jpg").write_bytes(b"png")
    (run.path / "renders" / "note.txt").write_text("keep")
    (run.path / "checkpoint.npz.part").write_bytes(b"left by a kill")
    refused(lambda: RunFolder.create(run.path), "--resume", "--overwrite")
    assert RunFolder.open(run.path).has_checkpoint
    new = RunFolder.create(run.path, overwrite=True)
    assert RunFolder.open(run.path).has_checkpoint  # what comes next may still refuse its input
    new.write_options({})
    (run.path / "options.json").unlink()
    left = sorted(p.relative_to(run.path).as_posix() for p in run.path.rglob("*"))
    assert left == ["mine.txt", "renders", "renders/note.txt"]


def test_options(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run.write_options(
        {
            "scene": "town",
            "options": {"seed": np.int64(3), "init": Path("a.ply")},
            "fingerprint": "f00",
            "device": "cpu",
        }
    )
    record = RunFolder.open(run.path).read_options()
    assert record.pop("date") and record.pop("command", None) is None
    assert record.pop("commit") is None or len(record) == 8
    assert record == {
        "scene": "../../town",
        "scene_absolute": str(tmp_path / "town"),
        "options": {"seed": 3, "init": "a.ply"},
        "fingerprint": "f00",
        "device": "cpu",
        "version": clsplat.__version__,
        "format": 1,
        "average": 0.0,
    }  # as in versions without it
    for text in ("{", "[]", ""):
        (run.path / "options.json").write_text(text)
        refused(run.read_options, "options.json")


def test_metrics(run):
    run.log({"event": "start"})
    for iteration in range(1, 6):
        run.log({"iteration": iteration, "loss": np.float32(0.5), "bad": float("nan"), "sizes": np.arange(2)})
        assert len(RunFolder(run.path).records()) == iteration + 1  # flushed
    assert run.records()[1] == {"iteration": 1, "loss": 0.5, "bad": None, "sizes": [0, 1]}
    run.rewind(3)
    assert [r.get("iteration") for r in run.records()] == [None, 1, 2, 3]
    run.log({"iteration": 4})
    assert [r.get("iteration") for r in run.records()] == [None, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "resume", [lambda run: run.log({"iteration": 3}), lambda run: (run.rewind(2), run.log({"iteration": 3}))]
)
def test_a_metrics_line_cut_by_a_kill(run, resume):
    for iteration in (1, 2):
        run.log({"iteration": iteration})
    with open(run.path / "metrics.jsonl", "ab") as file:
        file.write(b'{"iteration": 3, "lo')
    again = RunFolder(run.path)
    assert len(again.records()) == 2
    resume(again)
    assert [r["iteration"] for r in again.records()] == [1, 2, 3]


def test_damaged_metrics(run):
    run.rewind(5)  # nothing was logged yet: fine
    assert run.records() == []
    (run.path / "metrics.jsonl").write_text('{"iteration": 1}\nhello\n{"iteration": 2}\n')
    refused(run.records, "metrics.jsonl", "line 2")
    (run.path / "metrics.jsonl").write_text('{"format": "1"}\n')
    refused(run.records, "metrics.jsonl", "line 1", "format")


def options_of_format(run, number):
    run.write_options({"seed": 3})
    record = json.loads((run.path / "options.json").read_text("utf-8"))
    assert record.pop("format") == 1
    (run.path / "options.json").write_text(json.dumps(record | number), "utf-8")
    assert run.read_options()["seed"] == 3


def metrics_of_format(run, number):
    (run.path / "metrics.jsonl").unlink(missing_ok=True)
    run.log({"event": "plan"})
    run.log({"event": "step"})
    first, second = (json.loads(line) for line in (run.path / "metrics.jsonl").open(encoding="utf-8"))
    assert first.pop("format") == 1 and "format" not in second
    (run.path / "metrics.jsonl").write_text(json.dumps(first | number) + "\n", "utf-8")
    assert [record["event"] for record in run.records()] == ["plan"]


def checkpoint_of_format(run, number):
    run.save_checkpoint(ARRAYS, STATE)
    arrays = read_npz(run.path / "checkpoint.npz")
    assert json.loads(arrays["state.json"].tobytes())["format"] == 1
    with open(run.path / "checkpoint.npz", "wb") as file:
        write_npz(file, {**arrays, "state.json": state_array(STATE | number)})
    assert run.load_checkpoint()[1]["iteration"] == 500


def city_of_format(run, number):
    city = CityFolder(run.path)
    city.write({"fingerprint": "f00"})
    assert city.read()["format"] == 1
    (run.path / "city.json").write_text(json.dumps({"fingerprint": "f00"} | number), "utf-8")
    assert city.read()["fingerprint"] == "f00"


def block_of_format(run, number):
    record = {"number": 0, "city": "f00", "partition": "a", "options": {}} | number
    (run.path / "block.json").write_text(json.dumps(record), "utf-8")
    assert BlockFolder(run.path).read()["number"] == 0


@pytest.mark.parametrize(
    "name, write",
    [
        ("options.json", options_of_format),
        ("metrics.jsonl", metrics_of_format),
        ("checkpoint.npz", checkpoint_of_format),
        ("city.json", city_of_format),
        ("block.json", block_of_format),
    ],
)
def test_a_file_of_a_newer_clsplat_is_refused_and_one_without_a_number_is_read(run, name, write):
    for number in ({}, {"format": 0}, {"format": 1}):
        write(run, number)
    message = refused(lambda: write(run, {"format": 2}), name, "format 2", "install the newer clsplat")
    assert "damaged" not in message


def test_metrics_that_begin_anew_have_the_number_again(run):
    run.log({"event": "step", "iteration": 3})
    run.rewind(2)
    run.log({"event": "plan"})
    run.log({"event": "step"})
    assert run.records() == [{"event": "plan", "format": 1}, {"event": "step"}]


def test_checkpoint(run):
    assert not run.has_checkpoint
    refused(run.load_checkpoint, "checkpoint.npz", "no checkpoint")
    run.save_checkpoint({"positions": np.zeros(3)}, {})
    run.save_checkpoint(ARRAYS, STATE)
    assert run.has_checkpoint
    same(run.load_checkpoint())
    data = (run.path / "checkpoint.npz").read_bytes()
    run.save_checkpoint(ARRAYS, STATE)
    assert (run.path / "checkpoint.npz").read_bytes() == data
    with zipfile.ZipFile(run.path / "checkpoint.npz") as archive:
        assert {i.compress_type for i in archive.infolist()} == {zipfile.ZIP_STORED}
    plain = np.load(run.path / "checkpoint.npz", allow_pickle=False)
    assert json.loads(plain["state.json"].tobytes()) == {**STATE, "format": 1}


def test_checkpoint_cut_short(run):
    run.save_checkpoint(ARRAYS, STATE)
    path = run.path / "checkpoint.npz"
    data = path.read_bytes()
    for length in (0, 1, 30, len(data) // 3, len(data) // 2, len(data) - 30, len(data) - 1):
        path.write_bytes(data[:length])
        refused(run.load_checkpoint, "checkpoint.npz", "cut short")


@pytest.fixture
def full_disk():
    """No file may grow past 64 KiB, which fails as a full disk does."""
    resource = pytest.importorskip("resource")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65536, limit[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("count", [16_300, 1_000_000])
def test_full_disk_keeps_the_old_checkpoint(run, full_disk, count):
    run.save_checkpoint(ARRAYS, STATE)
    big = {"a": np.zeros(count, np.float32), "b": np.zeros(count, np.float32)}
    refused(lambda: run.save_checkpoint(big, {}), "checkpoint.npz", "space")
    assert [p.name for p in run.path.iterdir()] == ["checkpoint.npz"]
    same(run.load_checkpoint())


def test_full_disk_while_logging(run, full_disk):
    (run.path / "metrics.jsonl").write_bytes(b'{"iteration": 1}\n' * 3855)
    refused(lambda: run.log({"iteration": 2, "text": "x" * 99}), "metrics.jsonl", "space")
    assert len(run.records()) == 3855


def test_model_and_renders(run):
    refused(run.load_model, "point_cloud.ply", "no model")
    gaussians = Gaussians.from_points(np.eye(3), np.zeros((3, 3), np.uint8), 1)
    run.save_model(gaussians, np.array([1e6, 0, 0]), ["SplatRenderMode: default"])
    assert np.allclose(run.load_model().positions, gaussians.positions, atol=1e-3)
    assert b"comment SplatRenderMode: default\n" in (run.path / "point_cloud.ply").read_bytes()
    path = run.picture("left/0001.jpg")
    assert path == run.path / "renders" / "test" / "left" / "0001.jpg.png"
    assert path.parent.is_dir()
    refused(lambda: run.picture("../../../0001.jpg"), "0001.jpg")


@pytest.mark.slow
def test_every_flipped_byte_is_detected_or_harmless(run):
    run.save_checkpoint(ARRAYS, STATE)
    path = run.path / "checkpoint.npz"
    data = path.read_bytes()
    noticed = 0
    for position in range(0, len(data), 8):
        damaged = bytearray(data)
        damaged[position] ^= 0x55
        path.write_bytes(damaged)
        try:
            same(run.load_checkpoint())  # dates and attributes of the archive do not matter
        except InputError as error:
            noticed += 1
            assert "checkpoint.npz" in str(error) and "\n" not in str(error)
    assert noticed > len(data) / 8 * 0.6


MODEL = Gaussians.from_points(np.eye(3), np.zeros((3, 3), np.uint8), 0)


def made(folder):
    run = RunFolder.create(folder)
    run.write_options({})
    run.log({"event": "step"})
    run.save_model(MODEL, np.zeros(3))
    return run


def overwritten(run):
    RunFolder.create(run.path, overwrite=True).write_options({})
    return {path.relative_to(run.path).as_posix() for path in run.path.rglob("*")}


@pytest.mark.parametrize("place", ["renders", "renders/test"])
def test_a_folder_of_pictures_that_is_a_link_is_not_followed(tmp_path, place):
    run, link, theirs = made(tmp_path / "run"), tmp_path / "run" / place, tmp_path / "theirs"
    (theirs / "test").mkdir(parents=True)
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(theirs)
    run.picture("a.jpg").write_bytes(b"mine")
    overwritten(run)
    assert [path.read_bytes() for path in theirs.rglob("a.jpg.png")] == [b"mine"]
    assert link.is_symlink()


def test_a_link_to_a_model_is_removed_and_the_model_stays(tmp_path):
    run = made(tmp_path / "run")
    os.rename(run.path / "point_cloud.ply", tmp_path / "elsewhere.ply")
    (run.path / "point_cloud.ply").symlink_to(tmp_path / "elsewhere.ply")
    assert overwritten(run) == {"options.json"}
    assert (tmp_path / "elsewhere.ply").stat().st_size > 0


@pytest.mark.parametrize("name", ["report.html", "options.json", "metrics.jsonl"])
def test_a_folder_without_a_run_is_not_overwritten(tmp_path, name):
    """Another program's files may have the same names."""
    (tmp_path / name).write_text(json.dumps({"colour": "blue"}))
    refused(lambda: RunFolder.create(tmp_path, overwrite=True), "no run that clsplat wrote")
    assert (tmp_path / name).exists()


@pytest.mark.parametrize("damaged", ["{", ""])
def test_a_run_whose_options_are_damaged_is_overwritten(tmp_path, damaged):
    run = made(tmp_path / "run")
    (run.path / "options.json").write_text(damaged)
    assert overwritten(run) == {"options.json"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_city_is_not_overwritten_by_a_run(tmp_path, overwrite):
    run = made(tmp_path / "run")
    (run.path / "city.json").write_text("{}")
    refused(lambda: RunFolder.create(run.path, overwrite=overwrite), "holds a city")
    assert run.has_model


def test_partial_files_of_a_killed_process_are_replaced_and_a_link_is_not_followed(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "file.part").symlink_to(tmp_path / "mine")
    with replacing(tmp_path / "file") as file:
        file.write(b"new")
    assert (tmp_path / "file").read_bytes() == b"new" and not (tmp_path / "file").is_symlink()
    assert (tmp_path / "mine").read_text() == "mine"
