"""The progress line: what it says, that it fits, and that it never ends what it reports."""

import io
import os
import struct
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from clsplat.cli.progress import Progress, clock

ROOT = Path(__file__).resolve().parents[2]
TOLD = {"loss": 0.1542, "gaussians": 1_229_336, "memory_bytes": 9 << 30, "level": 3.0}


class Clock:
    """Replaces `time.monotonic`."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr("clsplat.cli.progress.time.monotonic", lambda: self.now)


def drawn(columns, report, monkeypatch):
    """What is sent to a terminal of this width, split at carriage returns."""
    fcntl, pty, termios = (pytest.importorskip(name) for name in ("fcntl", "pty", "termios"))
    try:
        reader, terminal = pty.openpty()
    except OSError as error:  # a container without /dev/pts
        pytest.skip(f"no pseudo terminal can be had here: {error}")
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    clock = Clock(monkeypatch)
    with os.fdopen(terminal, "w") as file, Progress(file=file) as progress:
        report(progress, clock)
    sent = b""
    try:
        while part := os.read(reader, 1 << 16):
            sent += part
    except OSError:  # the other end is closed
        pass
    os.close(reader)
    return sent.decode().replace("\n", "\r").split("\r")


def steps(progress, clock):
    """A run of which an hour is left."""
    progress.phase("compiling kernels")
    for iteration in (1, 50, 100, 150):
        progress(iteration=iteration, total=300_000, **TOLD)
        clock.now += 1
    progress.phase("evaluating")
    progress.message("PSNR 20 dB")


@pytest.mark.parametrize("columns", [20, 40, 80, 200])
def test_a_terminal_gets_one_line_that_fits(columns, monkeypatch):
    lines = drawn(columns, steps, monkeypatch)
    assert max(map(len, lines)) < columns
    assert "compiling kernels" in [line.strip() for line in lines] and "PSNR 20 dB" in lines
    training = [line for line in lines if line.startswith("training at 1/3")]
    assert training and not any("?" in line for line in lines)
    assert "left" not in training[0] and "it/s" not in training[0]  # nothing is known yet
    if columns == 80:
        assert training[-1].strip() == ("training at 1/3 size, [--------------------], 150/300000, "
                                        "1:40:37 left")
    if columns == 200:
        assert "1,229,336 gaussians, 9,216 MiB" in training[-1]


@pytest.mark.parametrize("seconds, text", [(0.4, "0s"), (59, "59s"), (65, "1:05"),
                                           (3722, "1:02:02"), (-1, "0s")])
def test_time_left_is_short(seconds, text):
    assert clock(seconds) == text


def test_a_log_has_a_line_a_phase_and_numbers_now_and_then(monkeypatch):
    log, clock = io.StringIO(), Clock(monkeypatch)
    with Progress(file=log, title="block 2 of 9") as progress:
        for _ in range(3):
            progress.phase("planning")
            progress.phase("evaluating")
        for iteration in range(0, 100, 10):
            progress(iteration=iteration, total=100, **TOLD)
            clock.now += 3
    lines = log.getvalue().splitlines()
    assert lines[:2] == ["block 2 of 9: planning", "block 2 of 9: evaluating"]
    assert [line.split(", ")[1] for line in lines[2:]] == ["0/100", "40/100", "80/100", "90/100"]


def test_things_are_counted(monkeypatch):
    log, clock = io.StringIO(), Clock(monkeypatch)
    with Progress(file=log) as progress:
        for photo in range(1, 13):
            clock.now += 1
            progress.count("photo", photo, 48)
    assert log.getvalue().splitlines()[-1] == "photo 12 of 48, 36s left"


def mapping_photos(progress, clock):
    """Features are counted, mapping is not, and counting ends long before the work."""
    for photo in range(1, 4):
        clock.now += 1
        progress.count("features, photo", photo, 3)
    progress.phase("global mapping")
    clock.now += 25
    progress._draw_line()  # as every second
    for photo in range(1, 29):
        clock.now += 1
        progress.count("incremental, photo", photo, 28)
    clock.now += 180
    progress._draw_line()


def test_what_nothing_foretells_shows_the_time_that_passed(monkeypatch):
    """Trial of f3a1525: global mapping stood at "0s left", a counter at "28 of 28" for minutes."""
    lines = [line.strip() for line in drawn(80, mapping_photos, monkeypatch) if line.strip()]
    assert "global mapping" in lines and "global mapping, 25s so far" in lines
    assert lines[-1] == "incremental, photo 28 of 28, [####################], 3:27 so far"
    assert "incremental, photo 14 of 28, [##########----------], 14s left" in lines
    assert not any(", 0s left" in line for line in lines)


def test_a_terminal_is_drawn_while_a_library_works(monkeypatch):
    monkeypatch.setattr("clsplat.cli.progress.TICK_SECONDS", 0.01)

    def works(progress, clock):
        progress.phase("global mapping")
        clock.now += 7
        threading.Event().wait(0.2)

    assert "global mapping, 7s so far" in [line.strip() for line in drawn(80, works, monkeypatch)]


class Failing(io.StringIO):
    """A stream that cannot be written."""

    def __init__(self, error):
        super().__init__()
        self.error, self.tried = error, 0

    def write(self, text):
        self.tried += 1
        raise self.error


@pytest.mark.parametrize("error", [BrokenPipeError(), OSError(28, "full"), ValueError("closed")])
def test_a_stream_that_cannot_be_written_is_tried_once(error, monkeypatch):
    file = Failing(error)
    with Progress(file=file) as progress:
        steps(progress, Clock(monkeypatch))
    assert file.tried == 1


def test_without_standard_error_nothing_is_written(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with Progress() as progress:
        steps(progress, Clock(monkeypatch))


def test_characters_that_a_terminal_lacks(monkeypatch):
    raw = io.BytesIO()
    with Progress(file=io.TextIOWrapper(raw, "ascii", write_through=True)) as progress:
        progress.message("Zürich \udcff")
        assert raw.getvalue() == b"Z\\xfcrich \\udcff\n"


@pytest.mark.slow
def test_synth_says_which_photo(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "clsplat", "synth", "-o", str(tmp_path / "city"), "--blocks", "1x1",
         "--views", "4", "--size", "32x24"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert lines[0] == "photo 1 of 4" and lines[-1].startswith("photo 4 of 4")
