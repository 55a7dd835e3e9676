"""Tasks on the workers of a Dask cluster: the only module that imports dask.

Dask places each task on a worker with a free device and begins it again elsewhere when the worker
dies. A task's body waits for a child process, so that the worker's event loop lives on.
"""

import logging
import os
import socket
import time
import uuid
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import clsplat
from clsplat.distribute.child import device_fault, in_child
from clsplat.distribute.task import FAILED, LOST, REFUSED, UNFIT, Result
from clsplat.errors import InputError

DEVICE = "device"  # the resource that workers declare
CONNECT_SECONDS = 10
PATIENCE_SECONDS = 600  # with a scheduler that restarts, and while no worker is there
LOOK_SECONDS = 2.0  # between looks at the cluster
RETIRE_TRIES = 20
STOPPED = "clsplat_stopped"  # attribute of a dask worker: the run that was stopped

log = logging.getLogger(__name__)


class Cluster:
    """A pool (see local.py) of the workers of the scheduler at `address`."""

    def __init__(self, address, began, program):
        self._address, self._began, self._program = address, began, program
        self._run = f"clsplat-{uuid.uuid4().hex}"
        self._client = None
        self._next_look = self._slots = 0
        self._connect(CONNECT_SECONDS)
        self._worker_seen = time.monotonic()

    def slots(self):
        if time.monotonic() >= self._next_look:
            self._look()
        return self._slots

    def submit(self, task):
        return self._client.submit(
            work, task, self._program, os.getcwd(), clsplat.__version__, self._run,
            key=f"{task.name}-{uuid.uuid4().hex}", resources={DEVICE: 1}, pure=False)

    def finished(self, futures):
        distributed = _distributed()
        if not futures:
            time.sleep(LOOK_SECONDS)
        else:
            with suppress(distributed.TimeoutError, distributed.CancelledError):
                distributed.wait(list(futures), LOOK_SECONDS, "FIRST_COMPLETED")
        ended = [(future, self._result(future)) for future in list(futures) if future.done()]
        lost = any(future.cancelled() for future, _ in ended)
        unfit = {result.worker: result for _, result in ended if result.ending == UNFIT}
        for worker, result in unfit.items():
            log.warning("%s; it gets no more tasks", result.message)
            self._retire(worker, [future for future, _ in ended])
        if lost:
            self._connect(PATIENCE_SECONDS)
        if not ended:
            self.slots()
        return ended

    def close(self):
        """Stops what is under way; the children save their states by themselves."""
        with suppress(Exception):  # the scheduler may be gone, and that is no matter now
            self._client.run(_stop, self._run)
        self._client.close(CONNECT_SECONDS)

    def _connect(self, seconds):
        if self._client is not None:
            log.warning("%s: lost, waiting for it for up to %d s", self._address, seconds)
            with suppress(Exception):
                self._client.close(1)
        self._client = _connected(self._address, seconds)
        self._client.subscribe_topic(self._run, lambda event: self._began(event[1]))

    def _look(self):
        """Count the devices of the cluster; InputError if there has long been none."""
        workers = ()
        with suppress(OSError, _distributed().TimeoutError, _distributed().CancelledError):
            workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        before, first = self._slots, not self._next_look
        self._slots = sum(int(worker["resources"].get(DEVICE, 0)) for worker in workers)
        now = time.monotonic()
        self._next_look = now + LOOK_SECONDS
        cure = (f"start workers with `dask worker {self._address} --nthreads 1 --resources "
                f"{DEVICE}=1`")
        if self._slots:
            self._worker_seen = now
        elif workers and first:
            raise InputError(f"--scheduler {self._address}: none of its {len(workers)} workers "
                             f"declares a device; {cure}")
        elif now - self._worker_seen > PATIENCE_SECONDS:
            raise InputError(f"--scheduler {self._address}: has had no worker with a device for "
                             f"{PATIENCE_SECONDS} s; {cure}; finished tasks are kept")
        elif before or first:
            log.warning("%s: has no worker with a device; waiting up to %d s; %s", self._address,
                        PATIENCE_SECONDS, cure)

    def _result(self, future):
        distributed = _distributed()
        if future.cancelled():
            return Result(LOST, "the scheduler was lost")
        try:
            return future.result(timeout=CONNECT_SECONDS)
        except (distributed.CancelledError, distributed.TimeoutError, OSError) as error:
            return Result(LOST, _line(error))
        except distributed.KilledWorker:
            return Result(LOST, "its workers died, one after the other")
        except Exception as error:  # noqa: BLE001  (whatever a foreign machine may raise)
            return Result(FAILED, f"a worker failed: {type(error).__name__}: {_line(error)}")

    def _retire(self, worker, futures):
        """Dask keeps a worker that holds the only copy of a result which somebody still wants."""
        for future in futures:
            future.release()
        with suppress(OSError, _distributed().TimeoutError):
            for _ in range(RETIRE_TRIES):
                if self._client.retire_workers([worker]):
                    break
                time.sleep(0.1)


def check_scheduler(address):
    """InputError where no Dask scheduler answers at this address."""
    _connected(address, CONNECT_SECONDS).close(CONNECT_SECONDS)


def _connected(address, seconds):
    """A client of the scheduler at `address`; InputError where none answers in so many seconds."""
    distributed = _distributed()
    try:
        return distributed.Client(address, timeout=seconds)
    except (OSError, ValueError, TypeError, distributed.TimeoutError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers ({_line(error)}); start one with "
            "`dask scheduler`, or correct the address; finished tasks are kept") from None


def work(task, program, folder, version, run):
    """Body of a task on a worker: the Result of one try, with the worker's address."""
    worker = _distributed().get_worker()
    worker.log_event(run, task.name)

    def stopping():
        return (getattr(worker, STOPPED, None) == run
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


def _fault(task, folder, version):
    """What keeps this machine from working on the task, and the cure, or ""."""
    for needed in (Path(folder), task.folder):
        if not needed.is_dir():
            return f"does not see {needed}; mount the same file system there"
    if clsplat.__version__ != version:
        return f"has clsplat {clsplat.__version__}, not {version}; install that"
    return ""


def _stop(run, dask_worker):
    setattr(dask_worker, STOPPED, run)


def _distributed():
    try:
        import distributed
    except ImportError:
        raise InputError("--scheduler: needs Dask; `pip install dask distributed`") from None
    return distributed


def _line(error):
    return " ".join(str(error).split()) or type(error).__name__
