"""Handles Ctrl-C and a scheduler's SIGTERM, so that no half step reaches the checkpoint."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = ("SIGINT", "SIGTERM", "SIGBREAK")  # the last is Windows's, for Ctrl-Break


class Interrupts:
    """A signal handler that counts signals, and raises KeyboardInterrupt unless it has to wait.

    The count remains where C code replaces or swallows the exception, so the end of a command
    checks `number`, that of the first signal, or 0.
    """

    def __init__(self) -> None:
        self.count = self.number = 0
        self._waits = self._ended = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self.number = self.number or number
        if not self._ended and (not self._waits or self.count > 1):
            raise KeyboardInterrupt

    def end(self) -> None:
        """Only count signals from now on: the command has ended, and what is left is to say so."""
        self._ended = True

    @contextmanager
    def waiting(self) -> Iterator[Callable[[], bool]]:
        """Only count the first signal during the block; yields a function: whether it came."""
        self._waits = True
        try:
            yield lambda: self.count > 0
        finally:
            self._waits = False


@contextmanager
def handled_interrupts() -> Iterator[Interrupts]:
    """Handle the signals that end a command during the block, except ignored ones.

    Outside the main thread this does nothing, as Python delivers no signals there.
    """
    handler, before = Interrupts(), {}
    if threading.current_thread() is threading.main_thread():
        numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
        before = {number: signal.signal(number, handler) for number in numbers
                  if signal.getsignal(number) is not signal.SIG_IGN}
    try:
        yield handler
    finally:
        handler.end()
        for number, was in before.items():
            signal.signal(number, was)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Defer the first Ctrl-C to the end of the block; the second raises KeyboardInterrupt at once.

    Yields a function that returns whether Ctrl-C was pressed.
    """
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, Interrupts):
        with handler.waiting() as interrupted:
            yield interrupted
    else:
        with handled_interrupts() as handler, handler.waiting() as interrupted:
            yield interrupted


def was_interrupted(error: BaseException) -> bool:
    """Whether Ctrl-C caused an exception, even if C code replaced the KeyboardInterrupt."""
    return isinstance(error, KeyboardInterrupt) or bool(
        getattr(signal.getsignal(signal.SIGINT), "count", 0))
