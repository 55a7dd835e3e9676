"""The parent's side of a child process that works on one task after the other."""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from queue import Empty, SimpleQueue

import clsplat
from clsplat.distribute.task import (
    DONE,
    FAILED,
    GRACE_SECONDS,
    HANG_SECONDS,
    INPUT,
    INTERRUPTED,
    LOG,
    LOST,
    QUIET_SECONDS,
    REFUSED,
    TERMINATED,
    Result,
    Task,
)
from clsplat.io.lock import latest_change

HUNG = 1000  # in place of an exit code
POLL_SECONDS = 0.2


class Child:
    """A child process, which is started for its first task or before, and anew after a task that
    fails.

    So the next task need not wait for imports, and finds its device open, but no task is begun by
    a process of which something went wrong.

    Parameters
    ----------
    device : the process's CLSPLAT_DEVICE; "" for that of this process.
    folder : its working folder; None for that of this process.
    """

    def __init__(self, device: str = "", folder: str | None = None) -> None:
        self.device, self._folder = device, folder
        self._process: subprocess.Popen[bytes] | None = None
        self._codes = SimpleQueue[int]()  # 0 for each task that succeeds, then the exit code

    def start(self, needed: Iterable[str]) -> None:
        """Start the process before its first task.

        Parameters
        ----------
        needed : MODULE or MODULE:CALL:ARG..., which it imports and calls meanwhile.
        """
        self._running(subprocess.DEVNULL, needed)

    def work(self, task: Task, program: str, stopping: Callable[[], bool] = lambda: False
             ) -> Result:
        """Try a task; the Result does not name a worker.

        Parameters
        ----------
        task : its folder exists.
        program : see `run`.
        stopping : polled; once it returns true, the process is told to save its state and end.
        """
        began = time.monotonic()
        try:
            code, log_start = self._tried(task, program, stopping)
            ending, message = _ending(task, code, log_start)
        except OSError as error:  # its folder was removed, or the disk is full
            ending, message = FAILED, f"{task.folder}: {error.strerror or error}"
        if ending != DONE:
            self.end()
        return Result(ending, message, time.monotonic() - began)

    def end(self) -> None:
        """Tell the process to end; one that works saves its state before."""
        if self._process and self._process.stdin:
            self._process.stdin.close()

    def close(self) -> None:
        """End the process, and wait for that."""
        self.end()
        if self._process:
            self._end_code(GRACE_SECONDS + 10)

    def _tried(self, task: Task, program: str, stopping: Callable[[], bool]) -> tuple[int, int]:
        """Have the process try a task; its code, and where its output begins in the log."""
        with open(task.folder / LOG, "ab") as log:
            log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} on {socket.gethostname()}: "
                      f"{program} {' '.join(task.command)}\n".encode())
            log.flush()
            log_start = log.tell()
            process = self._running(log.fileno())
        assert process.stdin is not None  # a pipe
        process.stdin.write(json.dumps([program, str(task.done), *task.command]).encode() + b"\n")
        process.stdin.flush()
        return self._code(stopping, task.folder), log_start

    def _running(self, log: int, needed: Iterable[str] = ()) -> subprocess.Popen[bytes]:
        """The process; where it must be started, with a file descriptor for what that says, and
        what it needs (`start`)."""
        process = self._process
        if process and process.poll() is None and process.stdin and not process.stdin.closed:
            return process
        # in a new session (on Windows: a new group), since Ctrl-C in the terminal is for the
        # parent, which passes it on once
        process = self._process = subprocess.Popen(
            [sys.executable, "-m", "clsplat.distribute.guarded", *needed],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, cwd=self._folder,
            env=environment(self.device), start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0))
        codes = self._codes = SimpleQueue[int]()

        def follow() -> None:
            assert process.stdout is not None  # a pipe
            with process.stdout as answers:
                for _ in answers:
                    codes.put(0)
            codes.put(process.wait())

        threading.Thread(target=follow, daemon=True).start()
        return process

    def _code(self, stopping: Callable[[], bool], folder: Path) -> int:
        """Wait for a task; HUNG if the process did nothing in its folder for too long, and was
        killed. Until then a warning names the folder now and then."""
        change, changed, notes = latest_change(folder), time.monotonic(), 0
        while True:
            try:
                return self._codes.get(timeout=POLL_SECONDS)
            except Empty:
                if stopping():
                    self.end()
                    return self._end_code(GRACE_SECONDS + 10)  # it ends itself before, or hangs
            idle = time.monotonic() - changed
            if idle > min(QUIET_SECONDS * (notes + 1), HANG_SECONDS):
                latest = latest_change(folder)
                if latest != change:
                    change, changed, notes = latest, time.monotonic(), 0
                elif idle > HANG_SECONDS:  # it could neither save its state nor end itself
                    self._end_code(0)
                    return HUNG
                else:
                    notes += 1
                    logging.getLogger(__name__).warning(
                        "%s: process %d has reported nothing for %.3g min; it may be stopped, or "
                        "its disk may hang; it is ended after %.3g min", folder,
                        self._process.pid if self._process else 0, idle / 60, HANG_SECONDS / 60)

    def _end_code(self, seconds: float) -> int:
        """Wait for a process that was told to end; after so many seconds it is killed."""
        assert self._process is not None
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return TERMINATED


def in_child(task: Task, program: str, device: str = "", folder: str | None = None,
             stopping: Callable[[], bool] = lambda: False) -> Result:
    """Try a task in a child process of its own; for the parameters see `Child` and its `work`."""
    child = Child(device, folder)
    try:
        return child.work(task, program, stopping)
    finally:
        child.close()


def environment(device: str = "") -> dict[str, str]:
    """The environment of a child: it imports the same clsplat, and uses `device` unless that is "".
    """
    paths = [str(Path(clsplat.__file__).parents[1]), os.environ.get("PYTHONPATH")]
    chosen = {"CLSPLAT_DEVICE": device} if device else {}
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **chosen}


def device_fault() -> str:
    """Why no OpenCL device of this machine can be used, in one line, or ""."""
    done = subprocess.run([sys.executable, "-m", "clsplat.distribute.probe"], env=environment(),
                          stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""


def _ending(task: Task, code: int, log_start: int) -> tuple[str, str]:
    """How a try ended, and the message of its Result, by a process's code."""
    if code == 0 and task.done.exists():
        return DONE, ""
    if code in (INTERRUPTED, TERMINATED):
        return LOST, "it was stopped"
    log = task.folder / LOG
    if code == HUNG:
        cause = f"it did nothing for {HANG_SECONDS} s, and was ended"
    elif code < 0:
        cause = f"it was ended by {signal.Signals(-code).name}"
    else:
        with open(log, "rb") as file:
            file.seek(log_start)
            lines = file.read().decode(errors="replace").strip().splitlines()
        cause = lines[-1].removeprefix("error: ") if lines else f"it ended with code {code}"
    if code == 0:
        cause = f"it ended without an error but did not write {task.done}"
    return REFUSED if code == INPUT else FAILED, f"{cause} (see {log})"
