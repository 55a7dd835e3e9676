"""`clsplat city` from scene to report: stages, going on after failures, and what it refuses."""

import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.cities import block as block_module
from clsplat.cities import cut
from clsplat.cities.city import City
from clsplat.cities.run import chosen_partition
from clsplat.cli.main import main
from clsplat.errors import OutOfDeviceMemory
from clsplat.io.photos.images import read_image
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.rendering.tree import MOST_SIGMA_PIXELS
from clsplat.training import loop
from tests.data.tiny_training import CITY
from tests.schedule.driven_sig import FACTS

pytestmark = pytest.mark.slow  # each decisions a city that is trained

# PoCL where the tests are not told otherwise
DEVICE = os.environ.get("CLSPLAT_TEST_DEVICES", "all").replace("all", "Portable")
FLAGS = (
    "-n",
    "60",
    "-r",
    "4",
    "--sh-degree",
    "1",
    "--exposure",
    "off",
    "--grid",
    "2x1",
    "--least-views",
    "3",
    "--device",
    DEVICE,
)


def keys(folder, *more):
    """The words that give what is no flag."""
    path = folder / "keys.toml"
    path.write_text("\n".join(("densify_from = 1000", 'form = "item"', *more)))
    return "--config", str(path)


def city(folder, *flags, code=0):
    with pytest.raises(SystemExit) as ended:
        main(["city", str(CITY), "-o", str(folder), "-q", *FLAGS, *flags, *keys(folder.parent)])
    assert ended.value.code == code
    return CityFolder(folder)


def command(*words, code=0):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words)])
    assert ended.value.code == code


def model(folder):
    return (folder.path / "point_cloud.ply").read_bytes()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return city(tmp_path_factory.mktemp("city") / "city")


@pytest.fixture
def copy(made, tmp_path):
    shutil.copytree(made.path, tmp_path / "city", symlinks=True)
    return CityFolder(tmp_path / "city")


def test_the_folder_is_a_run_like_any_other(made):
    run = RunFolder.open(made.path)
    last = [record for record in run.records() if record["event"] == "eval"][-1]
    parts = [RunFolder.open(path).records()[-1] for path in (made.coarse, *(block.run for block in made.blocks()))]
    assert len(parts) == 3
    assert not list(made.path.glob("*/report.html")) + list(made.path.glob("blocks/*/run/*.html"))
    assert all(
        RunFolder(path).is_finished for path in (made.path, made.coarse, *(block.run for block in made.blocks()))
    )
    assert last["iteration"] == sum(part["iteration"] for part in parts)
    assert last["train_seconds"] == pytest.approx(sum(part["train_seconds"] for part in parts))
    assert last["psnr"] > 12 and last["views"] == 4 and last["gaussians"] == run.load_model().count
    page = (made.path / "report.html").read_text()
    assert "map of the blocks" in page and "Seams" in page
    assert "Growth and loss" not in page and "Held-out views" in page  # no empty charts
    assert made.picture.is_file()
    command("eval", made.path, "--no-images", "--device", DEVICE)


def a_card(memory, is_cpu=False):
    return SimpleNamespace(
        name="a card", is_cpu=is_cpu, real=np.dtype(np.float32), handle=SimpleNamespace(global_mem_size=memory)
    )


def test_large_blocks_have_the_gpu_to_themselves(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    scene = read_scene(CITY)

    def chosen(given, memory=2**36, *numbers, is_cpu=False, **changes):
        return chosen_partition(
            given, City(CityFolder(tmp_path), scene, resolve({}, changes), a_card(memory, is_cpu)), *numbers or (None,)
        )

    assert chosen({"grid": (2, 2)}).workers == 4
    assert chosen({"grid": (2, 2)}, is_cpu=True).workers == 1
    # with margins 2.56 times as many gaussians as this
    assert chosen({"grid": (2, 2)}, schedule="mcmc", max_gaussians=8_000_000).workers == 2
    assert chosen({"grid": (3, 1)}).workers == 3
    assert chosen({}).workers == 1 and chosen({}).blocks == 1
    assert chosen({"grid": (2, 2)}, 2**36, 1).workers == 1
    assert chosen({"grid": (3, 3)}, 2**36, None, 2).workers == 6, "8 take as many rounds"
    assert chosen({}, 2**36, None, 2).least_blocks == 2, "one for each device"
    small = chosen({}, 2**22)  # a device that is full with one block
    assert small.blocks > 1 and small.workers == 1
    monkeypatch.setattr(os, "cpu_count", lambda: 11)
    assert chosen({"grid": (2, 2)}).workers == 2


def test_a_block_takes_as_many_steps_as_its_visits_say(made):
    training = 28  # of 32 views, which one run visits 60 times in all
    for block in made.blocks():
        record, views = block.read(), read_scene(block.path).views
        visits = np.array([block.region()[1][view.name] for view in views])
        assert 0 < visits.min() < visits.max() < 2 and len(views) == record["views"]
        assert record["options"]["iterations"] == round(60 * visits.sum() / training)
        assert record["options"]["test_every"] == 0 and record["options"]["levels"] == [1.0]
    assert RunFolder.open(made.coarse).read_options()["downscale"] == 8
    whole = City(made, None, resolve({}, {}), None)
    assert cut.block_steps(whole, 299.6, (640, 480), FACTS)["iterations"] == 300


def pictures(folder, out, *words):
    """float[K, H, W, 3], 0 to 1: the held-out views, as `clsplat render` draws them."""
    command("render", folder.path, "--views", "test", "-o", out, "--device", DEVICE, *words)
    return np.array([read_image(path) for path in sorted(out.rglob("*.png"))]) / 255


def test_a_tree_is_drawn_as_the_model_it_replaces(copy, tmp_path, capsys, monkeypatch):
    whole = pictures(copy, tmp_path / "whole")
    merged = RunFolder(copy.path).load_model()
    (copy.path / "point_cloud.ply").unlink()
    command("merge", copy.path, "--tree", "--device", DEVICE)
    assert f"{merged.count:,} gaussians of 2 blocks" in capsys.readouterr().out
    assert not (copy.path / "point_cloud.ply").exists()
    monkeypatch.setitem(MOST_SIGMA_PIXELS, False, 0.0)
    finest = pictures(copy, tmp_path / "finest", "--host-memory", "16")
    assert abs(finest - whole).max() <= 1 / 255
    monkeypatch.setitem(MOST_SIGMA_PIXELS, False, 1e6)
    far = pictures(copy, tmp_path / "far")
    assert 0.003 < abs(far - whole).mean() < 0.1
    command(
        "film",
        copy.path,
        "-o",
        tmp_path / "film",
        "--seconds",
        "0.1",
        "--fps",
        "20",
        "--size",
        "64x48",
        "--device",
        DEVICE,
    )
    assert len(list((tmp_path / "film").iterdir())) == 2
    command("merge", copy.path, "--device", DEVICE)  # of other blocks perhaps
    assert not (copy.path / "point_cloud.tree").exists()
    command("merge", copy.path, "--tree", "--against", copy.coarse, code=2)
    assert "--against: has no effect with --tree" in capsys.readouterr().err


def test_again_changes_nothing(copy, monkeypatch):
    before = model(copy)
    times = {path: path.stat().st_mtime_ns for path in copy.path.glob("blocks/*/run/*")}
    monkeypatch.setattr(loop.Training, "__init__", None)  # nothing is begun
    monkeypatch.setattr(cut, "find_windows", None)  # nor cut
    city(copy.path)
    assert model(copy) == before
    assert times == {path: path.stat().st_mtime_ns for path in copy.path.glob("blocks/*/run/*")}


def test_goes_on_where_it_was(copy):
    before = model(copy)
    shutil.rmtree(copy.block(1).run)
    shutil.rmtree(copy.block(0).path)
    (copy.path / "point_cloud.ply").unlink()
    city(copy.path)
    assert model(copy) == before


def test_stages_one_by_one_end_in_the_same(made, tmp_path):
    flags = [flag for flag in FLAGS if flag not in ("--grid", "2x1", "--least-views", "3")]
    flags[flags.index("-n") + 1], flags[flags.index("-r") + 1] = "30", "8"
    command("train", CITY, "--coarse", "-o", tmp_path / "coarse", "-q", *flags, *keys(tmp_path))
    command("partition", tmp_path, "--grid", "2x1", "--least-views", "3")
    for block in CityFolder(tmp_path).blocks():
        command("block", block.path, "-q")
    command("merge", tmp_path, "--device", DEVICE)
    assert model(CityFolder(tmp_path)) == model(made)


def test_a_missing_block_is_named_and_may_be_filled(copy, capsys):
    shutil.rmtree(copy.block(1).run)
    command("merge", copy.path, code=2)
    error = capsys.readouterr().err
    assert "1 of 2 blocks cannot be merged: 001 unfinished" in error and error.count("\n") == 1
    command("merge", copy.path, "--fill", "--device", DEVICE)
    assert "unfinished: its run has no model yet" in (copy.path / "report.html").read_text()


@pytest.mark.parametrize(
    "flags, cause",
    [
        (("--grid", "1x2"), "was cut with grid [2, 1], not [1, 2]"),
        (("-n", "70"), "was begun with iterations 60"),
        (("--init", "random"), "--init, --coarse"),
    ],
)
def test_other_options_are_refused(copy, capsys, flags, cause):
    city(copy.path, *flags, code=2)
    assert cause in capsys.readouterr().err


def test_a_block_that_does_not_fit_its_device_is_named(copy, monkeypatch, capsys):
    def train_block(*_):
        raise OutOfDeviceMemory("a small device: no memory for 1 MiB more")

    shutil.rmtree(copy.block(1).run)
    monkeypatch.setattr(block_module, "train_block", train_block)
    city(copy.path, code=2)
    error = capsys.readouterr().err
    assert "block 001 failed on this machine: a small device: no memory for 1 MiB more; " in error
    assert "--block-gaussians" in error and "1 of 2 blocks cannot be merged" in error


def test_a_model_that_cannot_be_written_loses_nothing(copy, capsys):
    before, blocking = model(copy), copy.path / "point_cloud.ply.part"
    (copy.path / "point_cloud.ply").unlink()
    blocking.mkdir()
    city(copy.path, code=2)
    assert "cannot be written" in capsys.readouterr().err
    blocking.rmdir()
    city(copy.path)
    assert model(copy) == before


def scores(folder):
    return [
        {key: value for key, value in record.items() if "seconds" not in key}
        for record in RunFolder(folder.path).records()
        if record["event"] in ("eval", "seams")
    ]


def test_two_workers_on_one_device_share_its_memory_budget_and_end_in_the_same(made, tmp_path):
    shared = city(tmp_path / "city", "--memory-budget", "1GiB", "--workers", "2")
    assert {block.read()["options"]["memory_budget"] for block in shared.blocks()} == {"512MiB"}
    assert {block.read()["options"]["memory_budget"] for block in made.blocks()} == {""}
    assert model(shared) == model(made)
    assert len(scores(made)) == 2 and scores(shared) == scores(made)
    for border in scores(made)[1]["borders"]:  # the merged model beside the coarse one
        assert border["psnr"] != border["reference_psnr"]
