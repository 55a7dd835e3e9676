"""What processes that tests start make of signals."""

import os
import signal

import pytest

needs_signals = pytest.mark.skipif(os.name == "nt", reason="Windows sends no signals to processes")


def _listen() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


# `preexec_fn` of a process that gets Ctrl-C: a shell's background job, and all that it starts,
# ignores it; Windows has no such function
listen = None if os.name == "nt" else _listen
