"""Help of the commands, and what a command imports before it has something to do."""

import re

import pytest

from clsplat.cli.main import main
from clsplat.config.option import options_of
from clsplat.options import TrainOptions
from tests.cli.test_cli import python
from tests.command_line import clsplat_
from tests.data.tiny_training import CITY


def test_help_lists_every_command_under_a_heading():
    result = clsplat_("--help")
    assert result.exit_code == 0
    for heading in ("Train:", "Data:", "Machine:"):
        assert f"\n{heading}\n" in result.output
    listed = result.output[result.output.index("\nTrain:") :].split()
    for name in ("train", "eval", "render", "export", "pack", "devices", "bench"):
        assert name in listed
    assert clsplat_().output == result.output


@pytest.mark.parametrize("name", sorted(main.commands))
def test_every_command_has_help(name):
    result = clsplat_(name, "--help")
    assert result.exit_code == 0 and "--traceback" in result.output
    shown = main.commands[name].get_short_help_str(64)  # as many as `clsplat --help` has room for
    assert shown.endswith(".") and not shown.endswith("...")


def test_help_is_short_and_help_all_is_whole():
    fields = [option.name.replace("_", "-") for option in options_of(TrainOptions) if option.metadata["flag"]]
    for name in ("train", "city"):
        short, whole = (clsplat_(name, flag).output for flag in ("--help", "--help-all"))
        assert len(short.splitlines()) < 0.75 * len(whole.splitlines())
        assert "--max-gaussians" in short and "--steps-scale" not in short
        assert f"more options: main {name} --help-all" in " ".join(short.split())
        missing = [f"--{field}" for field in fields if not re.search(rf"--{field}\b", whole)]
        assert not missing or name == "city", missing
    assert "more options" not in whole and len(fields) > 30


def test_help_loads_nothing_heavy():
    """Start-up must not wait for a driver; the modules are named because times vary."""
    code = (
        "import sys\nfrom clsplat.cli.main import main\n"
        "try:\n    main(['train', '--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'skimage', 'pyopencl', 'pycolmap', 'OpenImageIO', 'tqdm'}\n"
        "print('heavy:', sorted(heavy & set(sys.modules)))"
    )
    result = python("-c", code)
    assert result.stdout.rstrip().endswith("heavy: []"), result.stdout + result.stderr


@pytest.mark.slow
def test_a_training_imports_nothing_that_it_does_not_need(tmp_path):
    """From its start to its report: no other reader of scenes, and of scipy what finds neighbours."""
    code = (
        "import atexit, sys\natexit.register(lambda: print(*sys.modules))\n"
        "from clsplat.cli.main import main\nmain(sys.argv[1:])"
    )
    result = python("-c", code, "train", CITY, "-n", "1", "-q", "-o", tmp_path / "run")
    imported = set(result.stdout.split())
    assert {"scipy.spatial", "clsplat.io.scenes.colmap"} <= imported, result.stderr
    assert not imported & {
        "scipy.ndimage",
        "skimage",
        "pycolmap",
        "matplotlib",
        "clsplat.io.scenes.transforms",
        "clsplat.io.scenes.projects",
    }
