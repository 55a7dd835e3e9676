"""The child's side: python -m clsplat.distribute.guarded DONE MODULE WORDS... runs the module's
command line unless the file DONE exists, alone in that file's folder and with a kernel cache of its
own, and is interrupted when its standard input ends: as when its parent dies, or closes it.
"""

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

from clsplat.distribute.task import GRACE_SECONDS, HELD, INPUT, INTERRUPTED
from clsplat.errors import InputError
from clsplat.io.lock import Held, exclusive

PATIENCE_SECONDS = 300  # with another process in the folder, who may be in its grace


def main(done, module, *words):
    """Ends by SystemExit where the module does."""
    _follow_parent()
    done = Path(done)
    try:
        with ExitStack() as stack:
            stack.enter_context(exclusive(done.parent, PATIENCE_SECONDS))
            if done.exists():  # whoever held the lock has finished
                return
            os.environ["POCL_CACHE_DIR"] = str(_own_kernel_cache(stack))
            sys.argv = [module, *words]
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(HELD if isinstance(error, Held) else INPUT)


def _follow_parent():
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    pipe = os.dup(0)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)  # what this process starts shall not hold the pipe

    def watch():
        while os.read(pipe, 1):
            pass
        _interrupt()
        time.sleep(GRACE_SECONDS)
        os._exit(INTERRUPTED)

    threading.Thread(target=watch, daemon=True).start()


def _interrupt():
    """Raise Ctrl-C in the main thread, and end a system call of it where the platform can."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
    else:  # Windows
        _thread.interrupt_main()


def _own_kernel_cache(stack):
    """The first folder for compiled kernels that no other process of this machine holds: PoCL's is
    not safe across processes. (pyopencl's is off, see clsplat/device/runtimes.py.) Where it cannot
    be written, one in a temporary folder, which ends with the process."""
    base = _kernel_caches()
    for number in count() if base else ():
        folder = base / str(number)
        try:
            folder.mkdir(exist_ok=True)
            stack.enter_context(exclusive(folder))
            return folder
        except Held:
            pass
        except (OSError, InputError):  # another user's, or the disk is full
            break
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="clsplat-kernels-")))


def _kernel_caches():
    """The folder of this machine's kernel caches, made; None where none can be."""
    chosen = os.environ.get("POCL_CACHE_DIR")
    try:
        base = Path(chosen) if chosen else Path.home() / ".cache" / "clsplat" / "kernels"
        base = base / socket.gethostname()
        base.mkdir(parents=True, exist_ok=True)
        return base
    except (OSError, RuntimeError):  # a home that may not be written, or that nobody knows
        return None


if __name__ == "__main__":
    main(*sys.argv[1:])
