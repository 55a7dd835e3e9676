"""Ctrl-C, and SIGTERM of a scheduler: a step that was cut in half must not reach the checkpoint."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = ("SIGINT", "SIGTERM", "SIGBREAK")  # Windows has the last, for Ctrl-Break


class Interrupts:
    """A handler of signals that counts them, and raises KeyboardInterrupt unless it is told to
    wait.

    An exception that C code turned into another one, or swallowed, is still counted: who ends a
    command asks `number`.

    Attributes
    ----------
    count : signals so far.
    number : the first signal's number, or 0.
    """

    def __init__(self) -> None:
        self.count = self.number = 0
        self._waits = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self.number = self.number or number
        if not self._waits or self.count > 1:
            raise KeyboardInterrupt

    @contextmanager
    def waiting(self) -> Iterator[Callable[[], bool]]:
        """While the block runs, the first signal is noted only; yields whether there was one."""
        self._waits = True
        try:
            yield lambda: self.count > 0
        finally:
            self._waits = False


@contextmanager
def handled_interrupts() -> Iterator[Interrupts]:
    """Handle the signals that end a command, one that is ignored left aside, until the block ends.

    Outside the main thread Python delivers no signals, and nothing changes.
    """
    handler, before = Interrupts(), {}
    if threading.current_thread() is threading.main_thread():
        numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
        before = {number: signal.signal(number, handler) for number in numbers
                  if signal.getsignal(number) is not signal.SIG_IGN}
    try:
        yield handler
    finally:
        for number, was in before.items():
            signal.signal(number, was)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether Ctrl-C was pressed since; the second one raises
    KeyboardInterrupt at once."""
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, Interrupts):
        with handler.waiting() as interrupted:
            yield interrupted
    else:
        with handled_interrupts() as handler, handler.waiting() as interrupted:
            yield interrupted


def was_interrupted(error: BaseException) -> bool:
    """Whether an exception comes of Ctrl-C, also where C code made another one of it."""
    return isinstance(error, KeyboardInterrupt) or bool(
        getattr(signal.getsignal(signal.SIGINT), "count", 0))
