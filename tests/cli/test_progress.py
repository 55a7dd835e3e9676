"""The progress line: what it says, that it fits, and that it never ends what it reports."""

import io
import os
import struct
import threading

import pytest

from clsplat.cli.progress import Progress, clock
from clsplat.cli.train import time_line

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
        assert training[-1].strip() == ("training at 1/3 size, 150/300000, 1:40:37 left, [--------------------]")
    if columns == 200:
        assert "1,229,336 gaussians, 9,216 MiB" in training[-1]


@pytest.mark.parametrize("seconds, text", [(0.4, "0s"), (59, "59s"), (65, "1:05"), (3722, "1:02:02"), (-1, "0s")])
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
    assert [line.split(", ")[1] for line in lines[2:]] == ["0/100", "40/100", "80/100"]


def test_a_terminal_is_drawn_while_a_library_works(monkeypatch):
    monkeypatch.setattr("clsplat.cli.progress.TICK_SECONDS", 0.01)

    def works(progress, clock):
        progress.phase("global mapping")
        clock.now += 7
        threading.Event().wait(0.2)

    assert "global mapping, 7s so far" in [line.strip() for line in drawn(80, works, monkeypatch)]


def test_what_the_seconds_were_spent_for(monkeypatch):
    now = [10.0]
    monkeypatch.setattr("clsplat.training.progress.time.perf_counter", lambda: now[0])
    progress = Progress(file=io.StringIO(), began=8.5)
    for seconds, phase in (
        (0, "planning"),
        (1, "finding dense points: photo 1 of 2"),
        (2, "finding dense points: photo 2 of 2"),
        (1, "training at 1/2 size"),
        (4, "evaluating"),
        (1, "training at full size"),
        (2, "of no kind"),
        (1, "writing the checkpoint"),
        (0.25, "writing the report"),
    ):
        now[0] += seconds
        progress.phase(phase)
    now[0] += 0.02
    spent = progress.spent()
    assert list(spent.items()) == [
        ("imports", 1.5),
        ("plan", 1),
        ("dense points", 3),
        ("steps", 7),
        ("evaluation", 1),
        ("files", 0.25),
        ("report", 0.02),
    ]
    assert time_line(spent) == (
        "time:    13.8 s: imports 1.5, plan 1.0, dense points 3.0, steps 7.0, evaluation 1.0, files 0.2"
    )
    assert time_line(spent, 1.25).startswith("time:    13.8 s: imports 0.2, poses 1.2, plan 1.0")
    assert progress.spent() == spent  # no second is counted twice
