"""The progress line of a command: what it is doing, how far it is, how long it will take."""

import os
import sys
import time
from collections import deque

WIDTH = 80  # columns, where a terminal does not tell
DRAW_SECONDS, LOG_SECONDS = 0.1, 10.0  # at least, between numbers on a terminal, and in a log
MARKS = 8  # latest reports, over which speed is measured


class Progress:
    """One line that says what is being done, and of a training iteration, time left, speed, loss,
    gaussians and memory; a context manager, which may be entered again.

    A terminal has one line, redrawn, of which as much is shown as fits. A log has a line a phase,
    and one of numbers now and then. Where nothing can be written any more, the line goes quiet and
    the command goes on.

    Parameters
    ----------
    stop_at : the iteration at which this run stops before its end, or 0.
    file : a text stream; None is standard error.
    title : what the line begins with, such as "block 2 of 9".
    """

    def __init__(self, stop_at: int = 0, file=None, title: str = "") -> None:
        self._stop_at, self._title = stop_at, title
        self._file = sys.stderr if file is None else file  # None where that is closed
        self._live = self._is_terminal()
        self._drawn = 0  # columns of the line that stands on the terminal
        self._logged, self._latest = set(), None
        self._shown_at = -float("inf")
        self._marks, self._rate = deque(maxlen=MARKS), None
        self._what, self._numbers = "", []

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_) -> None:
        if self._live:
            self._draw("")
        elif self._latest:
            self._log(self._latest)
            self._latest = None

    def __call__(self, iteration: int, total: int, loss: float, gaussians: int, memory_bytes: int,
                 level: float) -> None:
        """Show the numbers of a training step."""
        end = min(self._stop_at or total, total)
        self._report(f"training level {level:g}", iteration, end, f"{iteration}/{end}", "it/s", [
            (4, f"loss {loss:.4f}"), (5, f"{gaussians:,} gaussians"),
            (6, f"{memory_bytes / 2**20:,.0f} MiB")])

    def count(self, what: str, done: int, total: int) -> None:
        """Show that so many of `total` things are done: "photo", 3, 48."""
        self._report(f"{what} {done} of {total}", done, total)

    def phase(self, text: str) -> None:
        """Say what is being done now; speed is not measured over it. A phase that goes on may be
        named again."""
        if text == self._what:
            return
        self._marks.clear()
        self._what = text
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

    def _report(self, what, done, total, reached="", unit="", more=()):
        """Show numbers, at once where the phase is new and else where they are due."""
        now, before = time.monotonic(), self._what
        self._measure(now, done)
        self._what = what
        self._numbers = [(1, reached)] if reached else []
        if self._rate:
            self._numbers.append((2, f"{clock((total - done) / self._rate)} left"))
            if unit:
                self._numbers.append((3, f"{self._rate:.1f} {unit}"))
        self._numbers += more
        self._latest = ", ".join([self._titled(what), *(text for _, text in self._numbers)])
        if self._live and (before != what or now - self._shown_at >= DRAW_SECONDS):
            self._shown_at = now
            self._draw_line()
        elif not self._live and now - self._shown_at >= LOG_SECONDS:
            self._shown_at = now
            self._log(self._latest)
            self._latest = None

    def _measure(self, now, done):
        if self._marks and now > self._marks[0][0]:
            self._rate = max(0, done - self._marks[0][1]) / (now - self._marks[0][0])
        self._marks.append((now, done))

    def _titled(self, what):
        return f"{self._title}: {what}" if self._title else what

    def _draw_line(self):
        self._draw(fitted([(0, self._titled(self._what)), *self._numbers], self._columns() - 1))

    def _draw(self, line):
        """Put `line` in the place of the one before, on a terminal."""
        if self._live and (line or self._drawn):
            self._write("\r" + line.ljust(self._drawn) + ("" if line else "\r"))
            self._drawn = len(line)

    def _log(self, line):
        self._write(line + "\n")

    def _columns(self):
        try:
            return os.get_terminal_size(self._file.fileno()).columns or WIDTH
        except (OSError, ValueError, AttributeError):
            return WIDTH

    def _is_terminal(self):
        try:
            return self._file.isatty()
        except (OSError, ValueError, AttributeError):
            return False

    def _write(self, text):
        """To the stream, while that works: a reader that went away must not end a training."""
        if self._file is None:
            return
        try:
            try:
                self._file.write(text)
            except UnicodeEncodeError:  # a terminal with few letters
                self._file.write(text.encode("ascii", "backslashreplace").decode())
            self._file.flush()
        except (OSError, ValueError):
            self._file = None


def fitted(fields: list[tuple[int, str]], width: int) -> str:
    """The texts of fields [(priority, text), ...], with commas between them, in at most `width`
    columns: the least important, those of the largest numbers, are left out until the rest fits."""
    kept = list(fields)
    while len(kept) > 1 and len(", ".join(text for _, text in kept)) > width:
        kept.remove(max(kept))
    return ", ".join(text for _, text in kept)[:width]


def clock(seconds: float) -> str:
    """Such as 42s, 3:05 or 1:02:03."""
    minutes, seconds = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minutes:02d}:{seconds:02d}"
    return f"{minutes}:{seconds:02d}" if minutes else f"{seconds}s"
