"""The progress line of a command: its current phase, its progress, and the time that is left, or
that has passed if the end is unknown."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import TextIO

from clsplat.training.progress import SilentProgress, training_at

DEFAULT_COLUMNS = 80  # of a terminal that gives none
DRAW_SECONDS, LOG_SECONDS = 0.1, 10.0  # least time between numbers on a terminal, and in a log
SPEED_REPORTS = 8  # latest reports, over which speed is measured
TICK_SECONDS = 1.0  # between two drawings on a terminal, where nothing is reported meanwhile
NOTED_SECONDS = 2.0  # a phase that has taken longer than this shows its time
BAR = 20  # characters
UNKNOWN = -float("inf")  # time at which a phase ends, or at which nothing was shown


class Progress(SilentProgress):
    """A line with the current phase, and in training with iteration, time left, speed and loss.

    It is a context manager, which may be entered again. A terminal gets one line, redrawn every
    second and shortened to fit; a log a line for each phase, and numbers from time to time. If the
    stream cannot be written any more, the line ends and the command continues.

    Parameters
    ----------
    stop_at : the iteration at which this run stops before its end, or 0.
    file : a text stream. None: standard error.
    title : the beginning of the line, such as "block 2 of 9".
    began : see `SilentProgress`.
    """

    def __init__(
        self, stop_at: int = 0, file: TextIO | None = None, title: str = "", began: float | None = None
    ) -> None:
        super().__init__(began)
        self._stop_at, self._title = stop_at, f"{title}: " if title else ""
        self._file: TextIO | None = sys.stderr if file is None else file  # None if it is closed
        self._live = self._file is not None and self._file.isatty()
        self._drawn = 0  # columns of the line that is on the terminal
        self._logged: set[str] = set()  # phases
        self._shown_at = UNKNOWN
        self._lock = threading.RLock()  # of all above and of the phase
        self._ended = threading.Event()
        self._begin("")

    def __enter__(self) -> Progress:
        if self._live:
            self._ended = threading.Event()
            threading.Thread(target=self._tick, args=(self._ended,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        with self._lock:
            if self._live:
                self._draw("")

    def _tick(self, ended: threading.Event) -> None:
        """Draw the line again and again: its time passes also while a library works."""
        while not ended.wait(TICK_SECONDS):
            with self._lock:
                if self._drawn and not ended.is_set():
                    self._show()

    def __call__(
        self, iteration: int, total: int, loss: float, gaussians: int, memory_bytes: int, level: float
    ) -> None:
        """Show the numbers of a training step."""
        end = min(self._stop_at or total, total)
        self._report(
            training_at(level),
            ", {}/{}",
            iteration,
            end,
            " it/s",
            [f"loss {loss:.4f}", f"{gaussians:,} gaussians", f"{memory_bytes / 2**20:,.0f} MiB"],
        )

    def count(self, what: str, done: int, total: int) -> None:
        """Show how many of `total` things are done, such as "photo", 3, 48."""
        self._report(what, " {} of {}", done, total)

    def phase(self, text: str) -> None:
        """Show the current phase, which may be the same as before; speed is not measured in it."""
        super().phase(text)
        with self._lock:
            if text == self._phase:
                return
            self._begin(text)
            if self._live or text not in self._logged:
                self._logged.add(text)
                self._show()

    def message(self, text: str) -> None:
        """Print a line that stays."""
        with self._lock:
            self._draw("")
            self._write(text + "\n")
            if self._live:
                self._show()

    def _begin(self, what: str) -> None:
        """Begin a phase, of which nothing is known yet."""
        self._phase = self._text = what  # without and with numbers
        self._began, self._ends = time.monotonic(), UNKNOWN
        self._marks: deque[tuple[float, int]] = deque(maxlen=SPEED_REPORTS)  # time and progress
        self._numbers: list[str] = []  # the most important ones first

    def _report(self, phase: str, number: str, done: int, total: int, unit: str = "", more: Sequence[str] = ()) -> None:
        """Show numbers, but not more often than the stream should have them."""
        with self._lock:
            now, begins = time.monotonic(), phase != self._phase
            if begins:
                self._begin(phase)
            self._marks.append((now, done))
            seconds, steps = now - self._marks[0][0], done - self._marks[0][1]
            rate = steps / seconds if seconds > 0 and steps > 0 else 0.0
            self._text = phase + number.format(done, total)
            self._ends = now + (total - done) / rate if rate and done < total else UNKNOWN
            self._numbers = [
                _bar(done, total) if self._live else "",
                f"{rate:.1f}{unit}" if rate and unit else "",
                *more,
            ]
            if begins or done == total or now - self._shown_at >= (DRAW_SECONDS if self._live else LOG_SECONDS):
                self._shown_at = now
                self._show()

    def _time(self) -> str:
        """The time that is left or, if that is unknown or over, that has passed."""
        now = time.monotonic()
        if now < self._ends + TICK_SECONDS:
            return f"{clock(self._ends - now)} left"
        passed = now - self._began
        return f"{clock(passed)} so far" if passed >= NOTED_SECONDS else ""

    def _show(self) -> None:
        """Draw the line on a terminal, the most important first, or write it to a log."""
        fields = [text for text in (self._title + self._text, self._time(), *self._numbers) if text]
        if not self._live:
            self._write(", ".join(fields) + "\n")
        elif self._file is not None:
            columns = os.get_terminal_size(self._file.fileno()).columns or DEFAULT_COLUMNS
            while len(fields) > 1 and len(", ".join(fields)) >= columns:
                fields.pop()
            self._draw(", ".join(fields)[: columns - 1])

    def _draw(self, line: str) -> None:
        """Replace the line on a terminal."""
        if self._live and (line or self._drawn):
            self._write("\r" + line.ljust(self._drawn) + ("" if line else "\r"))
            self._drawn = len(line)

    def _write(self, text: str) -> None:
        """Write to the stream while that works: a closed pipe must not end a training."""
        if self._file is None:
            return
        try:
            self._file.write(text)
            self._file.flush()
        except (OSError, ValueError):
            self._file = None


def _bar(done: int, total: int) -> str:
    """A bar that is full at the end."""
    full = BAR * min(done, total) // max(1, total)
    return f"[{'#' * full}{'-' * (BAR - full)}]"


def clock(seconds: float) -> str:
    """A duration as text, such as 42s, 3:05 or 1:02:03."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minutes:02d}:{rest:02d}"
    return f"{minutes}:{rest:02d}" if minutes else f"{rest}s"
