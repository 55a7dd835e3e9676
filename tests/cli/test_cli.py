"""The command line: what it calls, what it prints, how it fails."""

import subprocess
import sys
import types
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

import clsplat
from clsplat.cli.devices import table
from clsplat.cli.evaluate import summary
from clsplat.cli.main import main
from clsplat.errors import ClsplatError, DeviceError, Interrupted
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.georeference.files import write_georeference, write_orientation
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from tests.command_line import clsplat_
from tests.data.tiny_model import write_scene
from tests.data.tiny_training import CITY

# of a variable that is not set; "" must not be the current folder
EMPTY_PATHS = [
    ("train", "scene", "-o", ""),
    ("train", ""),
    ("compare", ""),
    ("train", "scene", "-o", "run", "--config", ""),
]


def python(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)


def module(monkeypatch, name, **contents):
    """Replace a module by a stub."""
    made = types.ModuleType(name)
    made.__dict__.update(contents)
    monkeypatch.setitem(sys.modules, name, made)
    parent, _, child = name.rpartition(".")
    if parent in sys.modules:
        monkeypatch.setattr(sys.modules[parent], child, made, raising=False)
    return made


def raising(error):
    """A group like `main` with one command `fail`."""
    group = type(main)("clsplat")

    @click.command()
    @click.option("--traceback", is_flag=True, expose_value=False)
    def fail():
        raise error

    group.add_section("Fail", fail)
    return group


def test_version_and_module_entry():
    assert clsplat_("--version").output == f"clsplat {clsplat.__version__}\n"
    result = python("-m", "clsplat", "--version")
    assert (result.returncode, result.stdout) == (0, f"clsplat {clsplat.__version__}\n")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts(shell):
    """Those of click, as its documentation describes."""
    result = CliRunner().invoke(main, prog_name="clsplat", env={"_CLSPLAT_COMPLETE": f"{shell}_source"})
    assert result.exit_code == 0 and f"_CLSPLAT_COMPLETE={shell}_complete" in result.output


def test_a_users_error_is_one_line_and_exit_2():
    result = CliRunner().invoke(raising(DeviceError("none works; buy one")), ["fail"])
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == "error: none works; buy one\n"


def test_traceback_shows_where():
    result = CliRunner().invoke(raising(ClsplatError("no")), ["fail", "--traceback"])
    assert result.exit_code == 2
    assert "Traceback" in result.stderr and result.stderr.endswith("error: no\n")


def test_a_bug_shows_its_traceback_and_exit_1():
    result = CliRunner().invoke(raising(ZeroDivisionError("oh")), ["fail"])
    assert result.exit_code == 1
    assert "ZeroDivisionError: oh" in result.stderr and "bug in clsplat" in result.stderr


@pytest.mark.parametrize(
    "error, said",
    [
        (Interrupted("stopped at 5; go on with --resume"), "stopped at 5; go on with --resume"),
        (KeyboardInterrupt(), "interrupted: give the same command again"),
    ],
)
def test_interrupts_exit_130(error, said):
    result = CliRunner().invoke(raising(error), ["fail"])
    assert result.exit_code == 130 and result.stderr.strip() == said


@pytest.mark.parametrize(
    "arguments",
    [
        ("train", "scene"),
        ("train", "scene", "-o", "run", "--nonsense"),
        ("nonsense",),
        ("train", "scene", "-o", "run", "-n", "many"),
        ("train", "s", "-o", "r", "--poses", "steam"),
        *EMPTY_PATHS,
    ],
)
def test_wrong_usage_is_one_line_and_exit_2(arguments):
    result = clsplat_(*arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith("error: ")
    assert "--help`." in result.stderr or ": expects " in result.stderr
    assert result.stderr.count("\n") == 1
    assert (arguments in EMPTY_PATHS) == ("is empty; give a path" in result.stderr)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """(what a training printed, its folder); not to be changed."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "run.toml").write_text("iterations = 50\nseed = 1\npreset = 'paper'\n")
    result = clsplat_(
        "train",
        CITY,
        "-o",
        folder / "run",
        "-q",
        "--config",
        folder / "run.toml",
        "--seed",
        2,
        "-n",
        2,
        "-r",
        8,
        "--levels",
        1,
        "--test-every",
        "none",
    )
    assert result.exit_code == 0, result.output
    return result.output, folder / "run"


def test_a_run_records_what_its_flags_its_file_and_a_choice_set(trained):
    options = RunFolder.open(trained[1]).read_options()
    assert (options["seed"], options["iterations"]) == (2, 2), "flags win"
    assert (options["preset"], options["convergence"]) == ("paper", "paper")
    assert trained[0] == "", "it is quiet"


@pytest.mark.parametrize(
    "arguments, named",
    [
        (["--seed", "6"], "--seed"),
        (["--levels", "2", "--levels", "1"], "--levels"),
        (["-n", "900"], "--iterations"),
        (["--overwrite"], "--overwrite"),
        (["--up", "0", "0", "1"], "--up"),
    ],
)
def test_resume_refuses_another_run(trained, arguments, named):
    before = (trained[1] / "checkpoint.npz").read_bytes()
    result = clsplat_("train", CITY, "-o", trained[1], "--resume", *arguments)
    assert result.exit_code == 2 and result.stderr.startswith(f"error: {named}: ")
    assert (trained[1] / "checkpoint.npz").read_bytes() == before


@pytest.mark.parametrize(
    "arguments", [(CITY, "--sh-degree", 9), (CITY, "--schedules", "sig,constant", "--view"), ()], ids=str
)
def test_what_cannot_be_trained_leaves_no_folder(tmp_path, arguments):
    result = clsplat_("train", *arguments, "-o", tmp_path / "run")
    assert result.exit_code == 2 and not (tmp_path / "run").exists()


def test_up_is_not_asked_for_where_the_earth_is_known(tmp_path):
    """Maps and tiles of a run so trained would be turned against the earth."""
    scene = write_scene(tmp_path / "town")
    write_georeference(scene, Georeference("EPSG:32632", (5e5, 5.3e6, 200.0), "made", 0.1))
    result = clsplat_("train", scene, "-o", tmp_path / "run", "--up", 0, 0.1, 1)
    assert result.exit_code == 2 and "so its z axis points up" in result.stderr, result.output


def test_export_names_the_formats_it_knows(tmp_path):
    result = clsplat_("export", tmp_path, "-o", "model.obj")
    assert result.exit_code == 2
    assert all(name in result.stderr for name in ("model.obj", ".ply", ".sog"))


def test_export_writes_a_whole_model_only(tmp_path):
    run, output = tmp_path / "run", tmp_path / "model.ply"
    folder = RunFolder.create(run)
    folder.write_options({})
    write_orientation(run, (0.0, 0.0, 1.0))
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    model = Gaussians.from_points(points, np.full((3, 3), 99, np.uint8))
    model.rows["sh_rest"][:] = 0.1  # harmonics that nothing uses would not be written
    folder.save_model(model, [5e6, 0, 0])
    model = (run / "point_cloud.ply").read_bytes()
    result = clsplat_("export", run, "-o", output)
    assert result.exit_code == 0 and "3 gaussians" in result.output
    assert read_ply(output).count == 3
    output.unlink()
    (run / "point_cloud.ply").write_bytes(model[:-9])
    assert clsplat_("export", run, "-o", output).exit_code == 2
    assert not output.exists()


def test_eval_summary_labels_both():
    text = summary({"views": 3, "psnr": 20.123, "ssim": 0.5, "psnr_cc": 25.0, "ssim_cc": 0.75})
    rows = [line.split() for line in text.splitlines()]
    assert rows == [
        ["3", "held-out", "views"],
        ["PSNR", "SSIM"],
        ["plain", "20.12", "0.5000"],
        ["colour-corrected", "25.00", "0.7500"],
    ]
    text = summary(
        {
            "views": 1,
            "psnr": 20,
            "ssim": 0.5,
            "flip": 0.25,
            "lpips": 0.5,
            "psnr_cc": 25,
            "ssim_cc": 0.75,
            "flip_cc": 0.125,
            "lpips_cc": 0.375,
        }
    )
    rows = [line.split() for line in text.splitlines()]
    assert rows[1] == ["PSNR", "SSIM", "FLIP", "LPIPS"]
    assert rows[3] == ["colour-corrected", "25.00", "0.7500", "0.1250", "0.3750"]


def entry(index, works, **more):
    able = {
        "compute_units": 2,
        "memory_bytes": 3 << 30,
        "largest_buffer_bytes": 1 << 30,
        "local_bytes": 32 << 10,
        "opencl_c": "OpenCL C 1.2",
        "HAVE_DOUBLE": True,
        "HAVE_NATIVE_EXP": False,
    }
    return types.SimpleNamespace(
        index=index,
        platform="Platform",
        name=f"name {index}",
        type="cpu",
        works=works,
        reason="" if works else "does not build",
        cure="" if works else "reinstall it",
        capabilities=able if works else {},
        chosen=works,
        **more,
    )


def test_the_device_table_explains_devices_that_do_not_work():
    lines = table([entry(0, False), entry(1, True)]).splitlines()
    assert "does not work" in lines[1] and lines[2].strip() == "why:  does not build"
    assert lines[3].strip() == "cure: reinstall it"
    assert lines[4].startswith("*") and lines[4].endswith("works")
    assert lines[4].index("Platform") == lines[1].index("Platform")
    assert "3.0 GiB memory" in lines[5] and lines[5].endswith("OpenCL C 1.2, double")


@pytest.mark.parametrize("passed, code", [(True, 0), (False, 2)])
def test_devices_check_runs_on_each_that_works(monkeypatch, passed, code):
    opened = []
    module(
        monkeypatch,
        "clsplat.device",
        choose_device=opened.append,
        list_devices=lambda: [entry(0, True), entry(1, False), entry(2, True)],
    )
    module(
        monkeypatch,
        "clsplat.bench.selftest",
        check=lambda device: [("sort", True, "fine"), ("blend", passed or len(opened) == 2, "3e-7 off")],
    )
    result = clsplat_("devices", "--check")
    assert (opened, result.exit_code) == (["0", "2"], code)
    assert ("FAILED  blend: 3e-7 off" in result.output) is not passed
    assert ("error: the self-test failed on name 0; update" in result.output) is not passed


def test_a_report_tells_of_drivers_and_nothing_of_the_user(monkeypatch, item_device):
    def handle(extensions):
        return types.SimpleNamespace(
            driver_version=" 9.9 ",
            version="OpenCL 3.0",
            max_work_group_size=4096,
            address_bits=64,
            extensions=extensions,
        )

    def opened(handle):
        if handle.extensions:
            return item_device
        raise RuntimeError(f"no {Path.home()}/cache")

    module(
        monkeypatch,
        "clsplat.device",
        Device=opened,
        list_devices=lambda: [
            entry(0, True, handle=handle("cl_b cl_a")),
            entry(1, False),
            entry(2, True, handle=handle("")),
        ],
    )
    result = clsplat_("devices", "--report")
    assert result.exit_code == 0 and result.output.startswith(f"clsplat {clsplat.__version__}, ")
    lines = [line.strip() for line in result.output.splitlines()]
    for line in (
        "0, name 0 (Platform)",
        "driver: 9.9",
        "extensions: cl_a cl_b",
        "form: item",
        "work-items of a group, at most: 4,096",
        "wave: 32",
        "2, name 2 (Platform)",
        "cannot be opened: RuntimeError: no ~/cache",
    ):
        assert line in lines
    assert "1, name 1" not in result.output and str(Path.home()) not in result.output


def test_pack_copies_a_scene(tmp_path):
    folder = write_scene(tmp_path / "town")
    result = clsplat_("pack", folder, "-o", tmp_path / "copy")
    assert result.exit_code == 0 and "4 photos" in result.output
    read = read_scene(tmp_path / "copy")
    assert len(read.views) == 4 and len(read.points) == 30
    assert not any(view.source.is_symlink() for view in read.views)
    assert clsplat_("pack", folder, "-o", tmp_path / "half", "-r", 2).exit_code == 0
    assert read_scene(tmp_path / "half").views[0].camera.width == 24


def test_pack_replaces_nothing(tmp_path):
    folder = write_scene(tmp_path / "town")
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "letter.txt").write_text("mine")
    result = clsplat_("pack", folder, "-o", tmp_path / "copy")
    assert result.exit_code == 2 and "exists already" in result.stderr
    assert result.stderr.count("\n") == 1
    result = clsplat_("pack", folder, "-o", tmp_path / "other", "--images", "images_2")
    assert result.exit_code == 2 and "images_2" in result.stderr
    assert not (tmp_path / "other").exists()
