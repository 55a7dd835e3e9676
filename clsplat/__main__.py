"""The process of the command `clsplat`: `python -m clsplat`, and the console script."""

import atexit
import os
import signal
import stat
import sys
import warnings


def run() -> None:
    """Run the command line and exit.

    Importing it takes a while, in which Ctrl-C must not show where it was; and what a service
    started without standard streams opens first must not become one of them.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
    os.umask(os.umask(0) & ~stat.S_IRWXU)  # else its owner could not read what is written
    # products here have few columns: threads of BLAS only wait for the next one, busily
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # what a build of kernels says; `catch_warnings` there does not hold while other threads use it
    warnings.filterwarnings("ignore", "Non-empty compiler output")
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    from clsplat.cli.main import main

    try:
        main(prog_name="clsplat")
    except SystemExit as end:
        _ignore_signals()  # what is left is cleaning up
        if isinstance(end.code, int) and end.code > 128:  # interrupted
            atexit._run_exitfuncs()
            _flush()
            os._exit(end.code)  # Python would not wait for threads of OpenCL, and could crash
        raise
    except KeyboardInterrupt:  # a second Ctrl-C, just when the first one was about to be told
        _end(signal.SIGINT, None)
    finally:
        _ignore_signals()
        _flush()


def _ignore_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) in (_end, signal.SIG_DFL):
            signal.signal(number, signal.SIG_IGN)


def _end(number: int, frame: object) -> None:
    os.write(2, b"interrupted: give the same command again\n")
    os._exit(128 + number)


def _flush() -> None:
    """Python flushes standard output when it ends, and complains where nobody reads it."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


if __name__ == "__main__":
    run()
