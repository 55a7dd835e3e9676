"""The process of the command `clsplat`: `python -m clsplat`, and the console script."""

import gc
import os
import signal
import sys
import warnings


def run() -> None:
    """Run the command line and exit.

    Importing it takes a while, in which Ctrl-C must not show where it was.
    """
    # products here have few columns: threads of BLAS only wait for the next one, busily
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(20_000)  # imports leave no garbage, and a tenth of their time looked for it
    # what a build of kernels prints: `catch_warnings` there does not hold in several threads
    warnings.filterwarnings("ignore", "Non-empty compiler output")
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    from clsplat.cli.main import main

    try:
        main(prog_name="clsplat")
    except KeyboardInterrupt:  # a second Ctrl-C, just when the first one was about to be reported
        _end(signal.SIGINT, None)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # what is left is cleaning up
        try:
            sys.stdout.flush()
        except OSError:  # nobody reads it: Python, which flushes it again, would complain
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _end(number: int, frame: object) -> None:
    os.write(2, b"interrupted: give the same command again\n")
    os._exit(128 + number)


if __name__ == "__main__":
    run()
