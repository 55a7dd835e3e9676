"""What `clsplat city`, `partition`, `merge` and `plan` refuse before anything is trained."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from clsplat.city import blocks, finish, stages
from clsplat.city.merge import NEVER_FILLED, TRAINS, merge
from clsplat.cli.city import _beside
from clsplat.cli.main import main
from clsplat.distribute import Outcome, Workers, guarded, local, run
from clsplat.errors import InputError
from clsplat.io.lock import LockTaken
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.partition.options import PartitionOptions
from clsplat.training import loop
from clsplat.training.progress import WARNING, SilentProgress
from tests.city.test_merge import (  # noqa: F401  (fixtures)
    city,
    scene,
    states,
    trained_city,
)
from tests.data.tiny_training import CITY, trained

ROOT = Path(__file__).parents[2]
CITY_FLAGS = [
    ("--grid 0x0", "--grid 0x0: expects auto or blocks along both sides"),
    ("--grid 2", "--grid 2: expects auto or blocks along both sides"),
    ("--grid 1x1x1", "--grid 1x1x1: expects auto or blocks along both sides"),
    ("--grid -1x-1", "--grid -1x-1: expects auto or blocks along both sides"),
    ("--grid 1e3x1", "--grid 1e3x1: expects auto or blocks along both sides"),
    ("--grid 100000x100000", "makes 10,000,000,000 blocks, more than 10,000"),
    ("--grid 50x50", "makes 2,500 blocks, but the scene will have about 4,400 gaussians, enough"),
    ("--workers 0", "--workers 0: expects 1 to 1024"),
    ("--workers -1", "--workers -1: expects 1 to 1024"),
    ("--workers many", "many is not a number of workers; give auto"),
    ("--workers 1000000000", "--workers 1000000000: expects 1 to 1024"),
    ("--against nope.ply", "--against nope.ply: no such file"),
    ("--against /dev/zero", "--against /dev/zero: no such file"),
    ("--against .", "--against .: has no point_cloud.ply"),
    (f"--against {__file__}", "not a PLY"),
    ("--margin nan", "--margin nan: expects a number from 0 to 10"),
    ("--margin -5", "--margin -5: expects a number from 0 to 10"),
    ("--margin inf", "--margin inf: expects a number from 0 to 10"),
    ("--threshold nan", "--threshold nan: expects a number from 0 to 2"),
    ("--threshold -1", "--threshold -1: expects a number from 0 to 2"),
    ("--least-views -1", "--least-views -1: expects a whole number of at least 0"),
    ("--block-gaussians 1", "--block-gaussians 1: expects auto or a whole number of at least 100"),
    ("--block-gaussians -7", "--block-gaussians -7: expects auto or a whole number of at least"),
    ("--up 0 0 0", "--up 0 0 0: expects three numbers"),
    ("--up nan 0 1", "--up nan 0 1: expects three numbers"),
    ("--up 1e300 1e300 0", "--up 1e+300 1e+300 0: expects at most 1e+15"),
    ("--bounds 0 0 0 0", "--bounds 0 0 0 0: expects X0 Y0"),
    ("--bounds 0 0 1e300 1e300", "--bounds 0 0 1e+300 1e+300: expects at most 1e+15"),
    ("--bounds nan 0 1 1", "--bounds nan 0 1 1: expects X0 Y0"),
    ("--method quadtree", "--method"),
    ("--device 0,", "--device 0,: expects names"),
    ("--device 0,1 --workers 1", "names 2 devices for --workers 1"),
    ("--device 0,1 --workers 2 --scheduler x:1", "on each worker names its device"),
    ("--device 99", "no device matches '99'"),
    ("--scheduler nonsense", "--scheduler nonsense: no Dask scheduler answers"),
    ("--init random", "--init, --coarse"),
    ("--near 1e300", "--near 1e+300: expects at most"),
    ("--levels 1,2", "--levels 1,2: expects auto or factors that fall"),
]


def refused(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words)])
    error = capsys.readouterr().err
    assert ended.value.code == 2, error
    assert error.startswith("error: ") and error.count("\n") == 1, error
    return error


@pytest.mark.parametrize("flags, said", CITY_FLAGS)
def test_a_city_option_is_refused_before_anything_is_made(tmp_path, capsys, monkeypatch, flags,
                                                          said):
    if "scheduler nonsense" in flags:
        pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(loop, "Training", None)  # nothing is trained
    assert said in refused(capsys, "city", CITY, "-o", "made", "-r", "8", *flags.split(" "))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("flags, said", [
    ("--photos 0", "--photos 0: expects whole numbers from 1"),
    ("--photos 10,-1", "--photos 10,-1: expects"), ("--photos x", "--photos x: expects"),
    ("--photos 1,,2", "expects"), ("--photos " + "9" * 400, "expects whole numbers from 1"),
    ("--margin nan", "--margin nan: expects a number from 0 to 10"),
    ("--margin -1", "--margin -1: expects")])
def test_plan_refuses_before_it_takes_steps(capsys, monkeypatch, flags, said):
    monkeypatch.setattr("clsplat.estimate.forecast.Planned", None)
    assert said in refused(capsys, "plan", CITY, *flags.split(" "))


@pytest.mark.parametrize("words", [
    ("train", "", "-o", "x"), ("train", CITY, "-o", ""), ("city", CITY, "-o", ""), ("plan", ""),
    ("eval", ""), ("render", "", "-o", "x"), ("compare", ""), ("merge", ""), ("partition", ""),
    ("block", ""), ("synth", "-o", ""), ("train", CITY, "-o", "x", "--config", "")])
def test_an_empty_path_is_not_the_current_folder(tmp_path, capsys, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    assert "is empty; give a path" in refused(capsys, *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("given, made", [
    (".", "/data/town.city"), ("..", "/data.city"), ("../town", "../town.city"),
    ("a", "a.city"), ("a/", "a.city"), ("a.npz", "a.npz.city"), ("a/..", "/data/town.city")])
def test_where_a_city_goes_that_is_not_told(monkeypatch, given, made):
    monkeypatch.setattr(os, "getcwd", lambda: "/data/town")
    assert _beside(Path(given)) == Path(made)


def test_a_city_of_the_root_must_be_told_where_to_go():
    with pytest.raises(InputError, match="has no name; name the folder of the city with --output"):
        _beside(Path("/"))


@pytest.mark.parametrize("changes", [{"block_gaussians": 100, "expected": 10**9},
                                     {"least_blocks": 10**6}])
def test_a_chosen_grid_has_an_end(changes):
    with pytest.raises(InputError, match="blocks, more than 10,000; allow more gaussians in a"):
        PartitionOptions(**changes)


def test_no_more_children_than_tasks(monkeypatch, tmp_path):
    asked = []

    class Asked(local.Children):
        def __init__(self, number, *rest):
            asked.append(number)
            raise InputError("enough")

    monkeypatch.setattr("clsplat.distribute.Children", Asked)
    from clsplat.distribute import Task
    with pytest.raises(InputError, match="enough"):
        run([Task("a", (), tmp_path / "a" / "done")], workers=1000)
    assert asked == [1]


# --- a block that another process trains


@contextlib.contextmanager
def held_elsewhere(folder):
    code = ("import sys; from clsplat.io.lock import exclusive\n"
            "with exclusive(sys.argv[1]): print(1, flush=True); sys.stdin.read()")
    child = subprocess.Popen([sys.executable, "-c", code, folder], stdin=subprocess.PIPE,
                             stdout=subprocess.PIPE, cwd=ROOT)
    child.stdout.readline()
    try:
        yield child.pid
    finally:
        child.communicate()


@pytest.mark.parametrize("fill", [False, True])
def test_a_block_in_training_is_never_filled(city, scene, fill):  # noqa: F811
    (city.block(2).run / "point_cloud.ply").unlink()
    with held_elsewhere(city.block(2).run) as other:
        merged = merge(city, scene, fill)
        assert states(merged) == ["merged", "merged", TRAINS, "merged"] and TRAINS in NEVER_FILLED
        with pytest.raises(InputError, match=f"002 in training; .*process {other} on .* trains it"):
            merged.check()
    assert states(merge(city, scene, fill))[2] == ("coarse" if fill else "unfinished")


def test_a_merge_while_the_city_is_trained_is_refused(city, capsys):  # noqa: F811
    for words in (("merge", city.path), ("partition", city.path)):
        with held_elsewhere(city.path) as other:
            assert f"process {other} on" in refused(capsys, *words)


# --- where the home folder may not be written


@pytest.mark.parametrize("home", ["/proc", "/dev/null", ""])
def test_kernel_caches_without_a_home(monkeypatch, home, tmp_path):
    monkeypatch.delenv("POCL_CACHE_DIR", raising=False)
    monkeypatch.setenv("HOME", home or str(tmp_path / "file" / "home"))
    (tmp_path / "file").write_text("")
    with contextlib.ExitStack() as stack:
        folder = guarded._own_kernel_cache(stack)
        assert folder.is_dir() and folder.name.startswith("clsplat-kernels-")
        (folder / "kernel").write_text("")
    assert not folder.exists()


def test_kernel_caches_are_apart_and_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    with contextlib.ExitStack() as stack:
        first = guarded._own_kernel_cache(stack)
    assert first.is_dir() and first.is_relative_to(tmp_path) and first.name == "0"
    with held_elsewhere(first), contextlib.ExitStack() as stack:
        assert guarded._own_kernel_cache(stack).name == "1"
    assert issubclass(LockTaken, InputError)


# --- a training that loses all it has


@pytest.mark.slow
def test_a_training_that_prunes_everything_says_so(tmp_path, float_device):
    scene = read_scene(CITY)  # noqa: F811
    with pytest.raises(InputError, match="all gaussians were pruned after step [23]; there is no "
                                         "checkpoint yet: lower --prune-opacity"):
        trained(tmp_path, scene, float_device, prune_opacity=1.0, densify_from=0, densify_every=2,
                grow_threshold=1e9, iterations=6, densify_until=6)
    assert not (tmp_path / "point_cloud.ply").exists()


def test_costs_of_metrics_that_are_empty_are_nothing(city):  # noqa: F811
    runs = [RunFolder(city.coarse), RunFolder(city.block(0).run)]
    for each in runs:
        (each.path / "metrics.jsonl").write_text('{"event"')
    assert finish.cost(runs) == {"iteration": 0, "train_seconds": 0, "wall_seconds": 0}
    assert stages.COARSE_FACTOR == 2


@pytest.mark.parametrize("workers", [1, 2])
def test_which_block_is_trained_is_told(city, monkeypatch, workers):  # noqa: F811
    """Before each block, and when it has ended, here and in children."""
    said = []

    def run_here(given, tasks, progress=None, began=None, call=None):
        for task in tasks:
            began(task.name)
            if given.number == 1:
                call(task)
            progress(Outcome(task, True, 1.0, 1, "", ""))
        return []

    @contextlib.contextmanager
    def shown(title):
        said.append(title)
        yield

    monkeypatch.setattr(Workers, "run", run_here)
    monkeypatch.setattr(blocks, "expected_work", lambda block: 1)
    monkeypatch.setattr(blocks, "block_options", lambda block: None)
    monkeypatch.setattr(blocks, "train_block", lambda *_, **__: None)
    blocks.train_blocks(city, Workers(workers), progress=shown,
                        ended=lambda outcome, place: said.append(("ended", place)),
                        began=lambda name, place: said.append((name, place)))
    shows = ["block 2 of 4"] if workers == 1 else []
    assert said[2 + len(shows):][:2 + len(shows)] == [
        ("001", "block 2 of 4"), *shows, ("ended", "block 2 of 4")]
    assert len(said) == 4 * (2 + len(shows))


def test_warnings_of_photos_are_shown_with_q(capsys):
    silent = SilentProgress()
    silent.message("a line")
    silent.phase("reading")
    silent.message(f"{WARNING}all photos are black")
    assert capsys.readouterr().err == "warning: all photos are black\n"


def test_blocks_with_most_work_begin_first(city, monkeypatch):  # noqa: F811
    ran = []
    monkeypatch.setattr(Workers, "run", lambda _, tasks, **__: ran.extend(tasks) or [])
    monkeypatch.setattr(blocks, "expected_work", lambda block: int(block.path.name))
    blocks.train_blocks(city)
    names = [block.path.name for block in city.blocks()]
    assert [task.name for task in ran] == names[::-1] != names


def test_work_is_steps_times_trained_gaussians():
    record = {"own": 30, "margin": 12, "options": {"iterations": 100}}
    block = SimpleNamespace(read=lambda *_: record)
    assert blocks.expected_work(block) == 4200
    record["options"]["iterations"] = "many"  # refused when the block is trained
    assert blocks.expected_work(block) == 42
