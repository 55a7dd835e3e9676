"""Handles Ctrl-C and a scheduler's SIGTERM, so that no half step reaches the checkpoint."""

import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType

SIGNALS = ("SIGINT", "SIGTERM", "SIGBREAK")  # the last is Windows's, for Ctrl-Break


class Interrupts:
    """A signal handler that raises KeyboardInterrupt once more signals came than it may defer.

    `received` are their numbers, which remain where C code replaces or swallows the exception.
    """

    def __init__(self) -> None:
        self.received, self.deferred = list[int](), 0.0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.received.append(number)
        if len(self.received) > self.deferred:
            raise KeyboardInterrupt


@contextmanager
def handled_interrupts() -> Iterator[Interrupts]:
    """Handle the signals that end a command during the block, except ignored ones.

    Outside the main thread this does nothing, as Python delivers no signals there.
    """
    handler, before = Interrupts(), {}
    if threading.current_thread() is threading.main_thread():
        numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
        before = {
            number: signal.signal(number, handler)
            for number in numbers
            if signal.getsignal(number) is not signal.SIG_IGN
        }
    try:
        yield handler
    finally:
        handler.deferred = math.inf
        for number, was in before.items():
            signal.signal(number, was)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Defer the first Ctrl-C to the end of the block; the second raises KeyboardInterrupt at once.

    Yields a function that returns whether Ctrl-C was pressed.
    """
    known = signal.getsignal(signal.SIGINT)
    with nullcontext(known) if isinstance(known, Interrupts) else handled_interrupts() as handler:
        handler.deferred = 1
        try:
            yield lambda: bool(handler.received)
        finally:
            handler.deferred = 0


def was_interrupted(error: BaseException) -> bool:
    """Whether Ctrl-C caused an exception, even if C code replaced the KeyboardInterrupt."""
    return isinstance(error, KeyboardInterrupt) or bool(getattr(signal.getsignal(signal.SIGINT), "received", ()))
