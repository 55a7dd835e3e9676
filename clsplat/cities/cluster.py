"""The workers of a Dask cluster: the only module that imports dask.

    dask scheduler
    CLSPLAT_DEVICE=0 dask worker tcp://10.0.0.1:8786 --nthreads 1 --memory-limit 0 \\
        --resources device=1        # one for each device, named as in `clsplat train --device`
"""

import logging
import socket
import time
import uuid
from collections.abc import Collection
from contextlib import suppress
from typing import Any

import clsplat
from clsplat.cities.jobs import Job, Lost, Unfit, device_here, line_of
from clsplat.errors import DeviceError, InputError

CONNECT_SECONDS, POLL_SECONDS = 10, 2.0
WAIT_SECONDS = 600  # for a scheduler that restarts, and for a first worker
RETIRE_TRIES = 20
RESOURCE = "device"  # that workers declare
STOPPED = "clsplat_stopped"  # attribute of a Dask worker: the run that was stopped

log = logging.getLogger(__name__)


class Cluster:
    """Runs jobs on the workers of the Dask scheduler at `address`.

    Dask starts each job on a worker with a free device, and starts it again elsewhere when the
    worker dies.
    """

    def __init__(self, address: str) -> None:
        self._address, self._run = address, f"clsplat-{uuid.uuid4().hex}"
        self._client: Any = connected(address, CONNECT_SECONDS)
        self._next_poll, self._slots, self._worker_seen = 0.0, 1, time.monotonic()

    def slots(self) -> int:
        """The number of devices that the workers declare; InputError if there have been none for
        too long."""
        now, before = time.monotonic(), self._slots
        if now < self._next_poll:
            return before
        workers: Collection[dict[str, Any]] = ()
        with suppress(OSError, _distributed().TimeoutError, _distributed().CancelledError):
            workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        self._slots = sum(int(worker["resources"].get(RESOURCE, 0)) for worker in workers)
        self._next_poll = now + POLL_SECONDS
        cure = f"start workers with `dask worker {self._address} --nthreads 1 --resources {RESOURCE}=1`"
        if self._slots:
            self._worker_seen = now
        elif now - self._worker_seen > WAIT_SECONDS:
            raise InputError(
                f"--scheduler {self._address}: has had no worker with a device for "
                f"{WAIT_SECONDS} s; {cure}; finished jobs are kept"
            )
        elif before:
            log.warning("%s: has no worker with a device; waiting up to %d s; %s", self._address, WAIT_SECONDS, cure)
        return self._slots

    def submit(self, job: Job) -> Any:
        """Start the job on a worker with a free device."""
        return self._client.submit(
            _on_worker,
            job,
            clsplat.__version__,
            self._run,
            pure=False,
            key=f"{job.name}-{uuid.uuid4().hex}",
            resources={RESOURCE: 1},
        )

    def result(self, future: Any) -> tuple[Any, str]:
        """What the job returned; a worker that is unfit is removed from the cluster."""
        distributed = _distributed()
        try:
            if future.cancelled():
                log.warning(
                    "%s: connection lost, waiting for the scheduler for up to %d s", self._address, WAIT_SECONDS
                )
                self._client.close(1)
                self._client = connected(self._address, WAIT_SECONDS)
                raise Lost("the connection to the scheduler was lost")
            value, worker = future.result(timeout=CONNECT_SECONDS)
        except (distributed.CancelledError, distributed.TimeoutError, OSError) as error:
            raise Lost(line_of(error)) from None
        except distributed.KilledWorker:
            raise Lost("several workers died while they ran it") from None
        if isinstance(value, Unfit):
            log.warning("%s; it gets no more jobs", value)
            future.release()  # else Dask keeps the worker, as it holds the only copy of a result
            with suppress(OSError, distributed.TimeoutError):
                for _ in range(RETIRE_TRIES):
                    if self._client.retire_workers([worker]):
                        break
                    time.sleep(0.1)
            raise value
        return value, worker

    def close(self) -> None:
        """Let running jobs save their state, and end."""
        with suppress(Exception):  # the scheduler may have disappeared, which does not matter now
            self._client.run(_stop, self._run)
        self._client.close(CONNECT_SECONDS)


def connected(address: str, seconds: float = CONNECT_SECONDS) -> Any:
    """A Dask client of the scheduler; InputError if that does not answer within `seconds`."""
    distributed = _distributed()
    # it logs a traceback when a scheduler disappears, which is reported in one line here
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        return distributed.Client(address, timeout=seconds)
    except (OSError, ValueError, TypeError, distributed.TimeoutError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers ({line_of(error)}); start one with "
            "`dask scheduler`, or correct the address; finished jobs are kept"
        ) from None


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError("--scheduler: needs Dask; `pip install dask distributed`") from None
    return distributed


def _on_worker(job: Job, version: str, run: str) -> tuple[Any, str]:
    """Run a job of a `run` on a Dask worker, and return its result, or an Unfit, and the worker's
    address; `version` : of the clsplat that submitted it."""
    worker = _distributed().get_worker()

    def stopping() -> bool:
        return bool(getattr(worker, STOPPED, None) == run or worker.status.name not in ("running", "paused"))

    try:
        if not job.folder.is_dir():
            raise Unfit(f"does not see {job.folder}; mount the same file system on it")
        if clsplat.__version__ != version:
            raise Unfit(f"has clsplat {clsplat.__version__}, not {version}; install that")
        device = device_here(job.device, job.form)
    except DeviceError as error:
        name = "" if str(worker.name) == worker.address else f" {worker.name}"
        return Unfit(f"worker{name} at {worker.address} on {socket.gethostname()}: {error}"), worker.address
    return None if job.is_done else job.run(device, stopping=stopping), worker.address


def _stop(run: str, dask_worker: Any) -> None:
    setattr(dask_worker, STOPPED, run)
