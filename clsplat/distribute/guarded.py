"""The child process of a worker: python -m clsplat.distribute.guarded [MODULE[:CALL:ARG...] ...]

It imports these modules, and calls these functions. Each line of its standard input is a task, a
JSON array of MODULE, DONE and arguments: it runs the command line of MODULE with these arguments
unless the file DONE exists. The output is appended to the log in the folder of DONE, which is
locked meanwhile. After a task that succeeds it writes a line to its standard output, and waits for
the next; after any other it ends with the exit code. It has its own kernel cache. When its standard
input ends, because the parent closes it or dies, it ends too; a task that is running is
interrupted.
"""

from __future__ import annotations

import _thread
import importlib
import json
import os
import runpy
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path
from queue import SimpleQueue

from clsplat.distribute.task import GRACE_SECONDS, INPUT, INTERRUPTED, LOCKED, LOG
from clsplat.errors import ClsplatError, InputError
from clsplat.io.lock import LockTaken, exclusive, latest_change

LOCK_SECONDS = 300  # to wait for another process in the folder that may be saving its state


def main(needs: Iterable[str]) -> None:
    """Make ready what tasks need, and run the module of each task; raises SystemExit where that
    does, or with an exit code of task.py."""
    ready, working = threading.Event(), threading.Event()
    with os.fdopen(os.dup(1), "wb", buffering=0) as answers, ExitStack() as stack:
        tasks = _follow_parent(ready, working, stack)
        os.environ["POCL_CACHE_DIR"] = str(_own_kernel_cache(stack))
        for needed in needs:
            module, *call = needed.split(":")
            found = importlib.import_module(module)
            if call:
                with suppress(ClsplatError):  # the tasks will tell
                    getattr(found, call[0])(*call[1:])
        ready.set()
        while (line := tasks.get()) is not None:
            module, done, *arguments = json.loads(line)
            _run(module, arguments, Path(done))
            working.clear()
            answers.write(b"done\n")


def _run(module: str, arguments: list[str], done: Path) -> None:
    """Run the module once, unless the file `done` exists; returns if it succeeds."""
    try:
        _log_to(done.parent / LOG)
        with ExitStack() as stack:
            _lock(stack, done.parent)
            if done.exists():  # another process has finished the task
                return
            sys.argv = [module, *arguments]
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as ended:
        if ended.code:
            raise
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(LOCKED if isinstance(error, LockTaken) else INPUT)
    finally:
        sys.stdout.flush()


def _log_to(path: Path) -> None:
    """Append all output of this process, and of those that it starts, to a file."""
    with open(path, "ab") as log:
        for number in (1, 2):
            os.dup2(log.fileno(), number)


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


def _follow_parent(ready: threading.Event, working: threading.Event, stack: ExitStack
                   ) -> SimpleQueue[bytes | None]:
    """Read tasks from standard input in a thread; None is the last one, when that ends.

    Parameters
    ----------
    ready : until it is set, the end of standard input ends this process at once.
    working : set with each task; while it is set, the end of standard input interrupts this
        process, which is ended after the grace period.
    stack : is closed where the process ends at once.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    pipe = os.dup(0)
    with open(os.devnull, "rb") as empty:
        os.dup2(empty.fileno(), 0)  # so that child processes do not keep the pipe open
    tasks = SimpleQueue[bytes | None]()

    def watch() -> None:
        with os.fdopen(pipe, "rb") as lines:
            for line in lines:
                working.set()
                tasks.put(line)
        tasks.put(None)
        if not (ready.is_set() or working.is_set()):
            stack.close()
            os._exit(0)
        if working.is_set():
            _interrupt()
        time.sleep(GRACE_SECONDS)
        os._exit(INTERRUPTED)

    threading.Thread(target=watch, daemon=True).start()
    return tasks


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
    main(sys.argv[1:])
