"""A job of a city: an object that is pickled, and that returns an object or raises an exception.

A job may be started any number of times and continues where it stopped: what it trains has a lock
that ends with its process.
"""

import multiprocessing.util
import os
import socket
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any

from clsplat.device import Device, choose_device
from clsplat.errors import DeviceError, InputError
from clsplat.io.lock import LockTaken, exclusive
from clsplat.training.progress import SilentProgress

HERE = "this machine"


@dataclass(frozen=True)
class Job:
    """A piece of the work on a city; a subclass has more fields, and `run`.

    Attributes
    ----------
    name : differs from those of the other jobs of a run.
    folder : where it writes, on a file system that all workers see.
    device, form : of the worker's device, if CLSPLAT_DEVICE does not name it.
    after : names of jobs that must be finished before this one begins.
    done : a file that exists once the job is finished; None: the job is always run.
    """

    name: str
    folder: Path
    device: str = "auto"
    form: str = "auto"
    after: tuple[str, ...] = ()
    done: Path | None = None

    @property
    def is_done(self) -> bool:
        """Whether the job needs not be run."""
        return self.done is not None and self.done.exists()

    def run(
        self, device: Device, progress: SilentProgress | None = None, stopping: Callable[[], bool] = lambda: False
    ) -> Any:
        """Do the work; the result is pickled. Once `stopping` returns true, save the state and
        raise Interrupted."""
        raise NotImplementedError


class Unfit(DeviceError):
    """A worker cannot do a job that another may do."""


class Lost(Exception):
    """A worker has disappeared while it ran a job."""


def line_of(error: BaseException) -> str:
    """The message of an error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


# --- in a worker


@lru_cache(maxsize=1)
def device_here(name: str, form: str) -> Device:
    """The device of a worker, which stays open for the jobs that follow; CLSPLAT_DEVICE prevails.

    Its kernels are compiled into a folder that no other process of this machine uses."""
    os.environ["POCL_CACHE_DIR"] = str(_own_kernel_cache())
    return choose_device(os.environ.get("CLSPLAT_DEVICE") or name, form=form)


@lru_cache(maxsize=1)
def _own_kernel_cache() -> Path:
    """Lock a folder for compiled kernels that no other process of this machine uses.

    PoCL's cache is not safe across processes. (pyopencl's is off, see clsplat/device/runtimes.py.)
    Where no such folder can be written, it is a temporary one, which is removed with the process.
    """
    stack = ExitStack()
    multiprocessing.util.Finalize(None, stack.close, exitpriority=0)
    with suppress(OSError, RuntimeError, InputError):  # full, of another user, or no home folder
        base = Path(os.environ.get("POCL_CACHE_DIR") or Path.home() / ".cache/clsplat/kernels")
        for number in count():
            folder = base / socket.gethostname() / str(number)
            folder.mkdir(parents=True, exist_ok=True)
            with suppress(LockTaken):
                stack.enter_context(exclusive(folder))
                return folder
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="clsplat-kernels-")))
