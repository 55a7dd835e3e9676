"""Handles Ctrl-C and a scheduler's SIGTERM, so that no half step reaches the checkpoint."""

import _thread
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import ExtensionFileLoader
from types import FrameType
from typing import Any

SIGNALS = ("SIGINT", "SIGTERM", "SIGBREAK")  # the last is Windows's, for Ctrl-Break

AGAIN = 0.02  # seconds


class Interrupts:
    """A signal handler that counts signals, and raises KeyboardInterrupt unless told to wait.

    The count remains where C code replaces or swallows the exception, so the end of a command
    checks `number`.

    Attributes
    ----------
    count : signals so far.
    number : number of the first signal, or 0.
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
        """Only count the first signal during the block; yields a function that tells of it."""
        self._waits = True
        try:
            yield lambda: self.count > 0
        finally:
            self._waits = False


@contextmanager
def signals_held() -> Iterator[None]:
    """Hold signals back until the block ends, also the second one.

    Outside the main thread this does nothing, as Python delivers no signals there.
    """
    arrived: list[int] = []
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: handler for number in signal.valid_signals()
                  if callable(handler := signal.getsignal(number))}
    for number in before:
        signal.signal(number, lambda number, frame: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in reversed(before.items()):  # Ctrl-C last, as it may raise
            signal.signal(number, handler)
        for number in arrived:
            signal.raise_signal(number)


@contextmanager
def whole_imports() -> Iterator[None]:
    """Let signals wait for imports of extension modules that begin during the block.

    Modules in C++ that make enums by pybind11 or nanobind (OpenImageIO, pyopencl, matplotlib) call
    Python for it; where a signal handler raises an exception amid that, the process aborts.
    Outside the main thread this does nothing.
    """
    def held(method: Callable[[ExtensionFileLoader, Any], Any]
             ) -> Callable[[ExtensionFileLoader, Any], Any]:
        def whole(loader: ExtensionFileLoader, argument: Any) -> Any:
            with signals_held():
                return method(loader, argument)
        return whole

    names = ("create_module", "exec_module") * (
        threading.current_thread() is threading.main_thread())
    before = {name: getattr(ExtensionFileLoader, name) for name in names}
    for name, method in before.items():
        setattr(ExtensionFileLoader, name, held(method))
    try:
        yield
    finally:
        for name, method in before.items():
            setattr(ExtensionFileLoader, name, method)


@contextmanager
def handled_interrupts() -> Iterator[Interrupts]:
    """Handle the signals that end a command during the block, except ignored ones.

    Outside the main thread this does nothing, as Python delivers no signals there.
    """
    handler, before, hook = Interrupts(), {}, sys.unraisablehook

    def unraisable(what: Any) -> None:
        """Where an exception in a destructor would be shown and lost: send the signal once more, a
        little later, when the destructor is done."""
        if isinstance(what.exc_value, KeyboardInterrupt):
            again = threading.Timer(AGAIN, _thread.interrupt_main, (handler.number,))
            again.daemon = True
            again.start()
        else:
            hook(what)
    if threading.current_thread() is threading.main_thread():
        sys.unraisablehook = unraisable
        numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
        before = {number: signal.signal(number, handler) for number in numbers
                  if signal.getsignal(number) is not signal.SIG_IGN}
    try:
        with whole_imports():
            yield handler
    finally:
        handler.end()
        for number, was in before.items():
            signal.signal(number, was)
        sys.unraisablehook = hook


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Defer the first Ctrl-C to the end of the block; the second raises KeyboardInterrupt at once.

    Yields a function that tells whether Ctrl-C was pressed.
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
