"""How the command ends when it is interrupted, or when nobody can read what it says."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from clsplat.cli.train import ending
from tests.cli.test_cli import python, raising


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_that_a_library_made_an_error_of_is_no_bug(number, code, request):
    """Fault M5 of the hostile trial: KeyboardInterrupt raised in a callback of C code."""
    group = raising(None)

    @click.command("burn")
    def burn():
        try:
            signal.raise_signal(number)
            time.sleep(5)
        except KeyboardInterrupt:
            raise SystemError("<built-in> returned a result with an exception set") from None

    group.add_section("Burn", burn)
    was = signal.getsignal(number)
    before = signal.default_int_handler  # a job in the background of a shell ignores signals
    signal.signal(number, before)
    request.addfinalizer(lambda: signal.signal(number, was))
    result = CliRunner().invoke(group, ["burn"])
    assert result.exit_code == code and "bug" not in result.stderr
    assert result.stderr == "interrupted: give the same command again\n"
    assert signal.getsignal(number) is before


@pytest.mark.parametrize(
    "name, shown, page",
    [
        ("run", "run", "run.html"),
        ("my run", "'my run'", "'my run.html'"),
        ("v1.2", "v1.2", "v1.2.html"),
        ("out/", "out", "out.html"),
        ("a;b", "'a;b'", "'a;b.html'"),
    ],
)
def test_a_training_ends_with_what_can_be_done(name, shown, page, tmp_path, monkeypatch):
    """Trial of f3a1525: it named neither the report nor a page."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()
    look = [f"look:    clsplat view {shown}", f"send:    clsplat export {shown} -o {page}"]
    assert ending(Path(name)) == look  # its report could not be drawn
    (tmp_path / name / "report.html").touch()
    assert ending(Path(name)) == [f"report:  {Path(name)}/report.html", *look]
    place = SimpleNamespace(warnings=("the residual is large",))
    monkeypatch.setattr("clsplat.io.georeference.files.read_georeference", lambda path: place)
    assert ending(Path(name))[0] == "warning: the residual is large"
    monkeypatch.chdir(tmp_path / name)
    page = ending(Path())[-1].removeprefix("send:    clsplat export . -o ")
    assert page.strip("'") == f"{Path(name).name}.html"


@pytest.mark.parametrize("name", ["verdict", "say"])
def test_a_second_ctrl_c_while_the_first_one_is_told(name):
    result = python(
        "-c",
        "import signal, sys\nimport clsplat.__main__ as entry\n"
        "import clsplat.cli.main as cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "interrupt = lambda *_: signal.raise_signal(signal.SIGINT)\n"
        "cli.devices.invoke = interrupt\n"
        f"tell = cli.{name}\n"
        f"cli.{name} = lambda *words: (interrupt(), tell(*words))[1]\n"
        "sys.argv = ['clsplat', 'devices']\nentry.run()",
    )
    assert result.returncode == 130 and "Traceback" not in result.stderr
    told = result.stderr.strip()  # click begins a new line after ^C
    assert told == "interrupted: give the same command again"


def test_ctrl_c_while_the_program_starts():
    """Before the command line is there: no traceback, and the same exit code."""
    result = python(
        "-c",
        "import signal, sys\nimport clsplat.__main__ as entry\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Kill:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'clsplat.cli': signal.raise_signal(signal.SIGINT)\n"
        "sys.meta_path.insert(0, Kill())\nentry.run()",
    )
    assert (result.returncode, result.stderr) == (130, "interrupted: give the same command again\n")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has a full device")
def test_output_that_cannot_be_written_is_told():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "clsplat", "train", "--help"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and line.startswith("error: the output: No space left on device")


def test_a_reader_who_leaves_is_no_error():
    done = subprocess.run(
        ["sh", "-c", f'"{sys.executable}" -m clsplat train --help 2>&1 | true; echo done'],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Traceback" not in done.stdout + done.stderr and "done" in done.stdout


@pytest.mark.parametrize(
    "error, said, code",
    [
        (OSError(28, "No space left on device", "/data/a.ply"), "/data/a.ply: No space left", 2),
        (MemoryError(), "enough memory left", 2),
        (BrokenPipeError(32, "Broken pipe"), "", 141),
    ],
)
def test_what_the_machine_lacks_is_no_bug(error, said, code):
    result = CliRunner().invoke(raising(error), ["fail"])
    assert result.exit_code == code and said in result.stderr and "bug" not in result.stderr
