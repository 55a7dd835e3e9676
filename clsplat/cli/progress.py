"""The progress line of a command: its current phase, its progress, and the time that is left."""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Sequence
from typing import TextIO

from clsplat.training.progress import SilentProgress

DEFAULT_COLUMNS = 80  # where a terminal does not tell its width
DRAW_SECONDS, LOG_SECONDS = 0.1, 10.0  # least time between numbers on a terminal, and in a log
SPEED_REPORTS = 8  # latest reports, over which speed is measured


class Progress(SilentProgress):
    """A line with the current phase, and in training with iteration, time left, speed and loss.

    It is a context manager, which may be entered again. A terminal gets one line, which is redrawn
    and shortened to fit. A log gets a line for each phase, and a line of numbers from time to time.
    If the stream cannot be written any more, the line ends and the command continues.

    Parameters
    ----------
    stop_at : the iteration at which this run stops before its end, or 0.
    file : a text stream. None: standard error.
    title : the beginning of the line, such as "block 2 of 9".
    """

    def __init__(self, stop_at: int = 0, file: TextIO | None = None, title: str = "") -> None:
        self._stop_at, self._title = stop_at, title
        self._file: TextIO | None = sys.stderr if file is None else file  # None if it is closed
        self._live = self._is_terminal()
        self._drawn = 0  # columns of the line that is on the terminal
        self._logged: set[str] = set()  # phases
        self._latest = ""  # numbers that the log does not have yet
        self._shown_at = -float("inf")
        self._marks: deque[tuple[float, int]] = deque(maxlen=SPEED_REPORTS)  # time and progress
        self._rate = 0.0
        self._phase = ""
        self._numbers: list[tuple[int, str]] = []

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._draw("")
        elif self._latest:
            self._log(self._latest)
            self._latest = ""

    def __call__(self, iteration: int, total: int, loss: float, gaussians: int, memory_bytes: int,
                 level: float) -> None:
        """Show the numbers of a training step."""
        end = min(self._stop_at or total, total)
        self._report(f"training level {level:g}", iteration, end, f"{iteration}/{end}", "it/s", [
            (4, f"loss {loss:.4f}"), (5, f"{gaussians:,} gaussians"),
            (6, f"{memory_bytes / 2**20:,.0f} MiB")])

    def count(self, what: str, done: int, total: int) -> None:
        """Show how many of `total` things are done, such as "photo", 3, 48."""
        self._report(f"{what} {done} of {total}", done, total)

    def phase(self, text: str) -> None:
        """Show the current phase, which may be the same as before; speed is not measured in it."""
        if text == self._phase:
            return
        self._marks.clear()
        self._phase = text
        if self._live:
            self._draw_line()
        elif text not in self._logged:
            self._logged.add(text)
            self._log(self._titled(text))

    def message(self, text: str) -> None:
        """Print a line that stays."""
        self._draw("")
        self._write(text + "\n")
        if self._live:
            self._draw_line()

    def _report(self, phase: str, done: int, total: int, reached: str = "", unit: str = "",
                more: Sequence[tuple[int, str]] = ()) -> None:
        """Show numbers: on a terminal after DRAW_SECONDS or in a new phase, in a log after
        LOG_SECONDS or at the end."""
        now, before = time.monotonic(), self._phase
        self._measure(now, done)
        self._phase = phase
        self._numbers = [(1, reached)] if reached else []
        if self._rate:
            self._numbers.append((2, f"{clock((total - done) / self._rate)} left"))
            if unit:
                self._numbers.append((3, f"{self._rate:.1f} {unit}"))
        self._numbers += more
        self._latest = ", ".join([self._titled(phase), *(text for _, text in self._numbers)])
        if self._live and (before != phase or now - self._shown_at >= DRAW_SECONDS):
            self._shown_at = now
            self._draw_line()
        elif not self._live and (done == total or now - self._shown_at >= LOG_SECONDS):
            self._shown_at = now
            self._log(self._latest)
            self._latest = ""

    def _measure(self, now: float, done: int) -> None:
        if self._marks and now > self._marks[0][0]:
            self._rate = max(0, done - self._marks[0][1]) / (now - self._marks[0][0])
        self._marks.append((now, done))

    def _titled(self, phase: str) -> str:
        return f"{self._title}: {phase}" if self._title else phase

    def _draw_line(self) -> None:
        self._draw(fitted([(0, self._titled(self._phase)), *self._numbers], self._columns() - 1))

    def _draw(self, line: str) -> None:
        """Replace the line on a terminal."""
        if self._live and (line or self._drawn):
            self._write("\r" + line.ljust(self._drawn) + ("" if line else "\r"))
            self._drawn = len(line)

    def _log(self, line: str) -> None:
        self._write(line + "\n")

    def _columns(self) -> int:
        try:
            descriptor = self._file.fileno() if self._file else -1
            return os.get_terminal_size(descriptor).columns or DEFAULT_COLUMNS
        except (OSError, ValueError, AttributeError):
            return DEFAULT_COLUMNS

    def _is_terminal(self) -> bool:
        try:
            return self._file is not None and self._file.isatty()
        except (OSError, ValueError, AttributeError):
            return False

    def _write(self, text: str) -> None:
        """Write to the stream while that works: a closed pipe must not end a training."""
        if self._file is None:
            return
        try:
            try:
                self._file.write(text)
            except UnicodeEncodeError:  # a terminal with a small character set
                self._file.write(text.encode("ascii", "backslashreplace").decode())
            self._file.flush()
        except (OSError, ValueError):
            self._file = None


def fitted(fields: list[tuple[int, str]], width: int) -> str:
    """The texts of fields (priority, text), separated by commas, in at most `width` columns.

    The least important fields, which have the largest numbers, are left out until the rest fits.
    """
    kept = list(fields)
    while len(kept) > 1 and len(", ".join(text for _, text in kept)) > width:
        kept.remove(max(kept))
    return ", ".join(text for _, text in kept)[:width]


def clock(seconds: float) -> str:
    """A duration as text, such as 42s, 3:05 or 1:02:03."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minutes:02d}:{rest:02d}"
    return f"{minutes}:{rest:02d}" if minutes else f"{rest}s"
