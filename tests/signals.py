"""What processes that tests start make of signals."""

import signal


def listen() -> None:
    """`preexec_fn` of a process that gets Ctrl-C: a shell's background job, and all that it starts,
    ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
