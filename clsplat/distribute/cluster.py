"""A pool on the workers of a Dask cluster: the only module that imports dask.

Dask starts each task on a worker with a free device, and starts it again elsewhere when the worker
dies. On the worker, a task only waits for a child process, so that the event loop keeps running.
"""

from __future__ import annotations

import logging
import os
import socket
import time
import uuid
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import clsplat
from clsplat.distribute.child import device_fault, in_child
from clsplat.distribute.task import FAILED, LOST, REFUSED, UNFIT, Result, Task
from clsplat.errors import InputError

DEVICE = "device"  # the resource that workers declare
CONNECT_SECONDS = 10
WAIT_SECONDS = 600  # for a scheduler that restarts, and for a first worker
POLL_SECONDS = 2.0
RETIRE_TRIES = 20
STOPPED = "clsplat_stopped"  # attribute of a dask worker: the run that was stopped

log = logging.getLogger(__name__)


class Cluster:
    """A Pool of the workers of the Dask scheduler at `address`."""

    def __init__(self, address: str, began: Callable[[str], object], program: str) -> None:
        self._address, self._began, self._program = address, began, program
        self._run = f"clsplat-{uuid.uuid4().hex}"
        self._client: Any = None
        self._next_poll, self._slots = 0.0, 0
        self._connect(CONNECT_SECONDS)
        self._worker_seen = time.monotonic()

    def slots(self) -> int:
        """The number of devices that the workers declare."""
        if time.monotonic() >= self._next_poll:
            self._poll()
        return self._slots

    def submit(self, task: Task) -> Any:
        """Start the task on a worker with a free device."""
        return self._client.submit(
            work, task, self._program, os.getcwd(), clsplat.__version__, self._run,
            key=f"{task.name}-{uuid.uuid4().hex}", resources={DEVICE: 1}, pure=False)

    def finished(self, futures: Collection[Any]) -> list[tuple[Any, Result]]:
        """Wait a while for the first of the futures, and return those that ended."""
        distributed = _distributed()
        if not futures:
            time.sleep(POLL_SECONDS)
        else:
            with suppress(distributed.TimeoutError, distributed.CancelledError):
                distributed.wait(list(futures), POLL_SECONDS, "FIRST_COMPLETED")
        ended = [(future, self._result(future)) for future in list(futures) if future.done()]
        lost = any(future.cancelled() for future, _ in ended)
        unfit = {result.worker: result for _, result in ended if result.ending == UNFIT}
        for worker, result in unfit.items():
            log.warning("%s; it gets no more tasks", result.message)
            self._retire(worker, [future for future, _ in ended])
        if lost:
            self._connect(WAIT_SECONDS)
        if not ended:
            self.slots()
        return ended

    def close(self) -> None:
        """Stop the running tasks; their children save their states."""
        with suppress(Exception):  # the scheduler may have disappeared, which does not matter now
            self._client.run(_stop, self._run)
        self._client.close(CONNECT_SECONDS)

    def _connect(self, seconds: float) -> None:
        if self._client is not None:
            log.warning("%s: connection lost, waiting for the scheduler for up to %d s",
                        self._address, seconds)
            with suppress(Exception):
                self._client.close(1)
        self._client = _connected(self._address, seconds)
        self._client.subscribe_topic(self._run, lambda event: self._began(event[1]))

    def _poll(self) -> None:
        """Count the devices of the cluster; InputError if there have been none for too long."""
        workers: Collection[dict[str, Any]] = ()
        with suppress(OSError, _distributed().TimeoutError, _distributed().CancelledError):
            workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        before, first = self._slots, not self._next_poll
        self._slots = sum(int(worker["resources"].get(DEVICE, 0)) for worker in workers)
        now = time.monotonic()
        self._next_poll = now + POLL_SECONDS
        cure = (f"start workers with `dask worker {self._address} --nthreads 1 --resources "
                f"{DEVICE}=1`")
        if self._slots:
            self._worker_seen = now
        elif workers and first:
            raise InputError(f"--scheduler {self._address}: none of its {len(workers)} workers "
                             f"declares a device; {cure}")
        elif now - self._worker_seen > WAIT_SECONDS:
            raise InputError(f"--scheduler {self._address}: has had no worker with a device for "
                             f"{WAIT_SECONDS} s; {cure}; finished tasks are kept")
        elif before or first:
            log.warning("%s: has no worker with a device; waiting up to %d s; %s", self._address,
                        WAIT_SECONDS, cure)

    def _result(self, future: Any) -> Result:
        distributed = _distributed()
        if future.cancelled():
            return Result(LOST, "the connection to the scheduler was lost")
        try:
            result: Result = future.result(timeout=CONNECT_SECONDS)
            return result
        except (distributed.CancelledError, distributed.TimeoutError, OSError) as error:
            return Result(LOST, _line(error))
        except distributed.KilledWorker:
            return Result(LOST, "several workers died while they ran it")
        except Exception as error:  # noqa: BLE001  (another machine may raise anything)
            return Result(FAILED, f"a worker failed: {type(error).__name__}: {_line(error)}")

    def _retire(self, worker: str, futures: Iterable[Any]) -> None:
        """Remove a worker from the cluster.

        Dask keeps a worker that holds the only copy of a result, so the futures are released first.
        """
        for future in futures:
            future.release()
        with suppress(OSError, _distributed().TimeoutError):
            for _ in range(RETIRE_TRIES):
                if self._client.retire_workers([worker]):
                    break
                time.sleep(0.1)


def check_scheduler(address: str) -> None:
    """Raise InputError if no Dask scheduler answers at this address."""
    _connected(address, CONNECT_SECONDS).close(CONNECT_SECONDS)


def _connected(address: str, seconds: float) -> Any:
    """A Dask client of the scheduler; InputError if that does not answer within `seconds`."""
    distributed = _distributed()
    # it logs a traceback when a scheduler disappears, which is reported in one line here
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        return distributed.Client(address, timeout=seconds)
    except (OSError, ValueError, TypeError, distributed.TimeoutError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers ({_line(error)}); start one with "
            "`dask scheduler`, or correct the address; finished tasks are kept") from None


def work(task: Task, program: str, folder: str, version: str, run: str) -> Result:
    """Try a task on a Dask worker.

    Parameters
    ----------
    task : the task.
    program : see `clsplat.distribute.run`.
    folder : the working folder of the child.
    version : the version of clsplat that submitted the task.
    run : the name of the run, under which the start of the try is reported.

    Returns
    -------
    The Result, with the worker's address.
    """
    worker = _distributed().get_worker()
    worker.log_event(run, task.name)

    def stopping() -> bool:
        return bool(getattr(worker, STOPPED, None) == run
                or worker.status.name not in ("running", "paused"))

    fault = _fault(task, folder, version)
    result = Result(UNFIT, fault) if fault else in_child(
        task, program, folder=folder, stopping=stopping)
    if result.ending == REFUSED:
        fault = device_fault()
        if fault:
            result = replace(result, ending=UNFIT, message=fault)
    if result.ending == UNFIT:
        name = "" if str(worker.name) == worker.address else f" {worker.name}"
        result = replace(result, message=(
            f"worker{name} at {worker.address} on {socket.gethostname()}: {result.message}"))
    return replace(result, worker=worker.address)


def _fault(task: Task, folder: str, version: str) -> str:
    """Why this machine cannot run the task, with the cure, or ""."""
    for needed in (Path(folder), task.folder):
        if not needed.is_dir():
            return f"does not see {needed}; mount the same file system on it"
    if clsplat.__version__ != version:
        return f"has clsplat {clsplat.__version__}, not {version}; install that"
    return ""


def _stop(run: str, dask_worker: Any) -> None:
    setattr(dask_worker, STOPPED, run)


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError("--scheduler: needs Dask; `pip install dask distributed`") from None
    return distributed


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
