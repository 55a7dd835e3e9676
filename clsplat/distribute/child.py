"""The parent's side of a child process that works on a task."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import clsplat
from clsplat.distribute.task import (
    DONE,
    FAILED,
    GRACE_SECONDS,
    HANG_SECONDS,
    INPUT,
    INTERRUPTED,
    LOST,
    REFUSED,
    TERMINATED,
    Result,
    Task,
)
from clsplat.io.lock import latest_change

HUNG = 1000  # in place of an exit code
LOG = "log.txt"  # in the task's folder: the output of all tries
POLL_SECONDS = 0.2


def in_child(task: Task, program: str, device: str = "", folder: str | None = None,
             stopping: Callable[[], bool] = lambda: False) -> Result:
    """Try a task in a child process; the Result does not name a worker.

    Parameters
    ----------
    task : its folder exists.
    program : see `run`.
    device : the child's CLSPLAT_DEVICE; "" for that of this process.
    folder : the child's working folder; None for that of this process.
    stopping : polled; once it returns true, the child is told to save its state and end.
    """
    began = time.monotonic()
    try:
        code, log_start = _tried(task, program, device, folder, stopping)
        ending, message = _ending(task, code, log_start)
    except OSError as error:  # its folder was removed, or the disk is full
        ending, message = FAILED, f"{task.folder}: {error.strerror or error}"
    return Result(ending, message, time.monotonic() - began)


def _tried(task: Task, program: str, device: str, folder: str | None,
           stopping: Callable[[], bool]) -> tuple[int, int]:
    """Run a child to its end; its exit code, and where its output begins in the log."""
    with open(task.folder / LOG, "ab") as log:
        log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} on {socket.gethostname()}: {program} "
                  f"{' '.join(task.command)}\n".encode())
        log.flush()
        log_start = log.tell()
        # in a new session (on Windows: a new group), since Ctrl-C in the terminal is for the
        # parent, which passes it on once
        child = subprocess.Popen(
            [sys.executable, "-m", "clsplat.distribute.guarded", str(task.done), program,
             *task.command], stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=folder,
            env=environment(device), start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0))
    try:
        return _exit_code(child, stopping, task.folder), log_start
    finally:
        _end_input(child)


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


def _exit_code(child: subprocess.Popen[bytes], stopping: Callable[[], bool], folder: Path) -> int:
    """Wait for a child; HUNG if it did nothing in its folder for too long, and was killed."""
    change, changed = latest_change(folder), time.monotonic()
    while True:
        try:
            return child.wait(POLL_SECONDS)
        except subprocess.TimeoutExpired:
            if stopping():
                break
        if time.monotonic() - changed > HANG_SECONDS:
            latest = latest_change(folder)
            if latest == change:
                child.kill()  # it could neither save its state nor end itself
                child.wait()
                return HUNG
            change, changed = latest, time.monotonic()
    _end_input(child)
    try:
        return child.wait(GRACE_SECONDS + 10)  # it ends itself before, unless it hangs
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
        return TERMINATED


def _end_input(child: subprocess.Popen[bytes]) -> None:
    """Tell a child to save its state and end, see guarded.py."""
    assert child.stdin is not None  # a pipe
    child.stdin.close()


def _ending(task: Task, code: int, log_start: int) -> tuple[str, str]:
    """How a try ended, and the message of its Result, by a child's exit code."""
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
