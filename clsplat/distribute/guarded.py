"""The child process of a task: python -m clsplat.distribute.guarded DONE MODULE ARGUMENTS...

It runs the command line of MODULE unless the file DONE exists. Meanwhile it locks the folder of
DONE and has its own kernel cache. It is interrupted when its standard input ends, which happens
when the parent closes it or dies.
"""

from __future__ import annotations

import _thread
import os
import runpy
import signal
import socket
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from itertools import count
from pathlib import Path

from clsplat.distribute.task import GRACE_SECONDS, INPUT, INTERRUPTED, LOCKED
from clsplat.errors import InputError
from clsplat.io.lock import LockTaken, exclusive, latest_change

LOCK_SECONDS = 300  # to wait for another process in the folder that may be saving its state


def main(done_path: str, module: str, *arguments: str) -> None:
    """Run the module; raises SystemExit where the module does, or with an exit code of task.py."""
    _follow_parent()
    done = Path(done_path)
    try:
        with ExitStack() as stack:
            _lock(stack, done.parent)
            if done.exists():  # another process has finished the task
                return
            os.environ["POCL_CACHE_DIR"] = str(_own_kernel_cache(stack))
            sys.argv = [module, *arguments]
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(LOCKED if isinstance(error, LockTaken) else INPUT)


def _lock(stack: ExitStack, folder: Path) -> None:
    """Lock a folder; LockTaken once its process has done nothing there for LOCK_SECONDS.

    A worker that the scheduler has lost may still train the block, and finish it.
    """
    while True:
        before = latest_change(folder)
        try:
            stack.enter_context(exclusive(folder, LOCK_SECONDS))
            return
        except LockTaken:
            if latest_change(folder) == before:
                raise


def _follow_parent() -> None:
    """Interrupt this process when its standard input ends, and end it after the grace period."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    pipe = os.dup(0)
    with open(os.devnull, "rb") as empty:
        os.dup2(empty.fileno(), 0)  # so that child processes do not keep the pipe open

    def watch() -> None:
        while os.read(pipe, 1):
            pass
        _interrupt()
        time.sleep(GRACE_SECONDS)
        os._exit(INTERRUPTED)

    threading.Thread(target=watch, daemon=True).start()


def _interrupt() -> None:
    """Raise KeyboardInterrupt in the main thread, and end its system call where that is possible.
    """
    main_thread = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main_thread is not None:
        signal.pthread_kill(main_thread, signal.SIGINT)
    else:  # Windows
        _thread.interrupt_main()


def _own_kernel_cache(stack: ExitStack) -> Path:
    """Lock a folder for compiled kernels that no other process of this machine uses.

    PoCL's cache is not safe across processes. (pyopencl's is off, see clsplat/device/runtimes.py.)
    Where no such folder can be written, it is a temporary one, which is removed with the process.
    """
    base = _kernel_caches()
    for folder in (base / str(number) for number in count()) if base else ():
        try:
            folder.mkdir(exist_ok=True)
            stack.enter_context(exclusive(folder))
            return folder
        except LockTaken:
            pass
        except (OSError, InputError):  # of another user, or the disk is full
            break
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="clsplat-kernels-")))


def _kernel_caches() -> Path | None:
    """Create the folder of this machine's kernel caches; None where that is not possible."""
    chosen = os.environ.get("POCL_CACHE_DIR")
    try:
        base = Path(chosen) if chosen else Path.home() / ".cache" / "clsplat" / "kernels"
        base = base / socket.gethostname()
        base.mkdir(parents=True, exist_ok=True)
        return base
    except (OSError, RuntimeError):  # the home folder is read-only or unknown
        return None


if __name__ == "__main__":
    main(*sys.argv[1:])
