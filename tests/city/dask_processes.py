"""A Dask scheduler and workers as users start them: processes, here on one machine."""

import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STARTED_SECONDS, ENDED_SECONDS = 120, 120


class DaskProcesses:
    """A context manager; `address` is the scheduler's, `workers` are the workers' processes."""

    def __init__(self):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.scheduler, self.workers = None, []
        self._scratch = tempfile.TemporaryDirectory()

    def __enter__(self):
        self.start_scheduler()
        return self

    def __exit__(self, *_):
        for process in [*self.workers, self.scheduler]:
            self.kill(process)
        self._scratch.cleanup()

    def start_scheduler(self):
        """Start it, and wait until it listens: on a busy machine Dask itself starts slowly."""
        self.scheduler = self._dask("scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        deadline = time.monotonic() + STARTED_SECONDS
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), 1).close()
                return
            except OSError:
                assert time.monotonic() < deadline and self.scheduler.poll() is None
                time.sleep(0.05)

    def start_worker(self, *words, device="", resources="device=1"):
        """Start a worker, without a nanny unless `words` are given; device: its CLSPLAT_DEVICE."""
        self.workers.append(
            self._dask(
                "worker",
                self.address,
                "--nthreads",
                "1",
                "--no-dashboard",
                "--memory-limit",
                "0",
                "--local-directory",
                self._scratch.name,
                *(words or ["--no-nanny"]),
                *(["--resources", resources] if resources else []),
                device=device,
            )
        )
        return self.workers[-1]

    @staticmethod
    def kill(process):
        """End it as `kill -9` does; unlike a machine that is lost, it leaves no nanny behind."""
        if process.poll() is None:
            process.kill()
        process.wait(ENDED_SECONDS)

    def _dask(self, *words, device=""):
        environment = {**os.environ, "CLSPLAT_DEVICE": device, "PYTHONPATH": str(ROOT)}
        if not device:
            del environment["CLSPLAT_DEVICE"]
        with open(Path(self._scratch.name) / "log.txt", "ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "dask", *words],
                env=environment,
                cwd=self._scratch.name,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
