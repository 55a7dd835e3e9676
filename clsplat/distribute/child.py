"""The parent's side of a child process that works on a task."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import clsplat
from clsplat.distribute.task import (
    DONE,
    FAILED,
    GRACE_SECONDS,
    INPUT,
    INTERRUPTED,
    LOST,
    REFUSED,
    TERMINATED,
    Result,
)

LOG = "log.txt"  # in the task's folder: what all tries said
LOOK_SECONDS = 0.2


def in_child(task, program, device="", folder=None, stopping=lambda: False):
    """The Result of one try of a task in a process of its own, without a worker's name.

    program, device: as of `run`; folder: the child's working folder. stopping: asked several times
    a second; once it is true, the child is told to save its state and end.
    """
    begin = time.monotonic()
    with open(task.folder / LOG, "ab") as log:
        log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} on {socket.gethostname()}: {program} "
                  f"{' '.join(task.command)}\n".encode())
        log.flush()
        start = log.tell()
        # a session of its own (on Windows: a group): Ctrl-C in the terminal is for the parent, who
        # passes it on once
        child = subprocess.Popen(
            [sys.executable, "-m", "clsplat.distribute.guarded", str(task.done), program,
             *task.command], stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=folder,
            env=environment(device), start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0))
    try:
        code = _waited(child, stopping)
    finally:
        child.stdin.close()
    return Result(*_verdict(task, code, start), time.monotonic() - begin)


def environment(device=""):
    """Of a child: it imports this very clsplat, and takes `device` if that is given."""
    paths = [str(Path(clsplat.__file__).parents[1]), os.environ.get("PYTHONPATH")]
    chosen = {"CLSPLAT_DEVICE": device} if device else {}
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **chosen}


def device_fault():
    """Why this machine has no device to work with, in one line, or ""."""
    done = subprocess.run([sys.executable, "-m", "clsplat.distribute.probe"], env=environment(),
                          stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""


def _waited(child, stopping):
    while True:
        try:
            return child.wait(LOOK_SECONDS)
        except subprocess.TimeoutExpired:
            if stopping():
                child.stdin.close()
                return child.wait(GRACE_SECONDS + 10)  # it ends itself before


def _verdict(task, code, start):
    """(ending, message) of a child's exit code."""
    if code == 0 and task.done.exists():
        return DONE, ""
    if code in (INTERRUPTED, TERMINATED):
        return LOST, "it was stopped"
    log = task.folder / LOG
    if code < 0:
        cause = f"it was ended by {signal.Signals(-code).name}"
    else:
        with open(log, "rb") as file:
            file.seek(start)
            lines = file.read().decode(errors="replace").strip().splitlines()
        cause = lines[-1].removeprefix("error: ") if lines else f"it ended with code {code}"
    if code == 0:
        cause = f"it ended well but did not write {task.done}"
    return REFUSED if code == INPUT else FAILED, f"{cause} (see {log})"
