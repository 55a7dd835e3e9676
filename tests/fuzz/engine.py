"""Runs a reader on mutated files in processes that may die, and says which case killed which.

A case is told by (reader, seed, number) alone: `mutated_folder` makes it again. Workers are forked;
each says in shared memory which case it is at, so that an abort or a hang is blamed on that case
and another worker goes on behind it.
"""

import gc
import json
import mmap
import os
import random
import resource
import shutil
import signal
import struct
import tempfile
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io import colmap, colmap_child
from clsplat.io.checks import CONTROL
from tests.fuzz.mutate import mutated

SECONDS = 10  # a case that takes longer hangs
MEMORY_BYTES = 512 << 20  # a reader may take so much more than its process had
POLL_SECONDS = 0.02
LONGEST = 1000  # characters of a message
HEAD = struct.Struct("<BQ")  # of a child's answer: exit code, length
CASE, STARTED, ACCEPTED, REFUSED, WORST, PEAK, END = range(7)  # a worker's row in shared memory


@dataclass
class Outcome:
    """seconds: of the slowest case; peak_bytes: most that a worker, or a child of it, held; faults:
    (case, one line) each."""

    cases: int = 0
    accepted: int = 0
    refused: int = 0
    seconds: float = 0.0
    peak_bytes: int = 0
    faults: list = field(default_factory=list)


def mutation(reader, seeds, seed, case):
    """(index of a seed folder, relative path of its one mutated file, its bytes)."""
    chance = random.Random(f"{seed} {case}")
    at = chance.randrange(len(seeds))
    name = chance.choice([name for name in seeds[at] if name.endswith(reader.files)])
    other = chance.choice(seeds)
    return at, name, mutated(chance, seeds[at][name], other.get(name, seeds[at][name]),
                             reader.text)


def write_seed(seed, folder):
    for name, content in seed.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def fuzz(reader, count, seed=0, workers=2):
    """The Outcome of reading `count` mutated folders."""
    seeds = reader.seeds()
    outcome = Outcome(count)
    with tempfile.TemporaryDirectory(prefix="clsplat-fuzz-") as folder:
        shared = np.frombuffer(mmap.mmap(-1, 8 * END * workers)).reshape(workers, END)
        running = {}
        for number in range(workers):
            shared[number, CASE] = number - workers
            _start(reader, seeds, seed, range(number, count, workers), shared[number],
                   Path(folder) / str(number), running)
        while running:
            time.sleep(POLL_SECONDS)
            for process in list(running):
                _look_at(process, reader, seeds, seed, running, outcome)
        for place in Path(folder).glob("*/faults.jsonl"):
            outcome.faults += map(json.loads, place.read_text().splitlines())
    outcome.accepted, outcome.refused = (int(shared[:, key].sum()) for key in (ACCEPTED, REFUSED))
    outcome.seconds, outcome.peak_bytes = shared[:, WORST].max(), int(shared[:, PEAK].max())
    outcome.faults.sort()
    return outcome


def _start(reader, seeds, seed, cases, row, folder, running):
    row[STARTED] = time.monotonic()
    process = os.fork()
    if process == 0:
        try:
            _work(reader, seeds, seed, cases, row, folder)
            os._exit(0)
        except BaseException:  # a fault of this engine
            (folder / "failure").write_text(traceback.format_exc())
            os._exit(1)
    running[process] = cases, row, folder


def _look_at(process, reader, seeds, seed, running, outcome):
    """Reap a worker that ended, or end one that hangs, and go on behind its case."""
    cases, row, folder = running[process]
    ended, status = os.waitpid(process, os.WNOHANG)
    if not ended:
        if time.monotonic() - row[STARTED] < SECONDS:
            return
        os.killpg(process, signal.SIGKILL)  # and the child it waits for
        os.waitpid(process, 0)
    del running[process]
    if ended and status == 0:
        return
    code = os.waitstatus_to_exitcode(status) if ended else None
    if code == 1:
        raise RuntimeError((folder / "failure").read_text())
    cause = f"more than {SECONDS} s" if code is None else f"ended by {signal.Signals(-code).name}"
    outcome.faults.append([int(row[CASE]), cause])
    left = range(int(row[CASE]) + cases.step, cases.stop, cases.step)
    _start(reader, seeds, seed, left, row, folder, running)


def _work(reader, seeds, seed, cases, row, folder):
    os.setpgid(0, 0)
    shutil.rmtree(folder / "scratch", ignore_errors=True)  # of a worker that died
    places = [write_seed(content, folder / str(at)) for at, content in enumerate(seeds)]
    known = {place / name for place, content in zip(places, seeds) for name in content}
    scratch = folder / "scratch"
    scratch.mkdir()
    tempfile.tempdir = str(scratch)
    warnings.simplefilter("error", RuntimeWarning)  # numpy's: a reader says what is wrong itself
    _limit_memory()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng tells stderr all that it meets
    colmap._run_child = Child(folder / "complaints")
    gc.freeze()
    refused = [fault for fault in (try_case(reader, place) for place in places) if fault != ""]
    if refused:
        raise ValueError(f"a seed is not read: {refused}")
    for case in cases:
        at, name, content = mutation(reader, seeds, seed, case)
        row[CASE], row[STARTED] = case, time.monotonic()
        (places[at] / name).write_bytes(content)
        fault = try_case(reader, places[at])
        row[WORST] = max(row[WORST], time.monotonic() - row[STARTED])
        stray = [path for path in (*places[at].rglob("*"), *scratch.rglob("*"))
                 if path.is_file() and path not in known]
        if stray:
            fault = fault or f"left files behind: {[path.name for path in stray]}"
            for path in stray:
                path.unlink()
        (places[at] / name).write_bytes(seeds[at][name])
        row[ACCEPTED] += fault == ""
        row[REFUSED] += fault is None
        if fault:
            with open(folder / "faults.jsonl", "a") as file:
                file.write(json.dumps([case, fault]) + "\n")
    colmap._run_child.close()
    row[PEAK] = max(row[PEAK], 1024 * max(resource.getrusage(who).ru_maxrss for who in (
        resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


def try_case(reader, folder):
    """"" if the folder was read, None if it was refused as it should be, else the fault."""
    try:
        reader.read(folder)
        return ""
    except InputError as error:
        message, cause = str(error), error
        while cause is not None and not isinstance(cause, MemoryError):
            cause = cause.__context__
        if cause is not None or "bad_alloc" in message or "MemoryError" in message:
            return f"more memory than allowed: {message}"
        if CONTROL.search(message) or len(message) > LONGEST:
            return f"no clear line: {message[:300]!r}"
        return None
    except Exception as error:
        where = [f"{Path(frame.filename).name}:{frame.lineno}"
                 for frame in traceback.extract_tb(error.__traceback__)]
        return f"{type(error).__name__}: {str(error)[:200]!r} at {' '.join(where[-4:])}"


def _limit_memory():
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


class Child:
    """In place of `colmap._run_child`: one forked child reads model after model until it dies,
    without the half second that starting Python takes each time."""

    def __init__(self, complaints):
        self.complaints, self.process = complaints, None

    def __call__(self, model, limit):
        if self.process is None:
            self._start()
        os.write(self.tasks, json.dumps(str(model)).encode() + b"\n")
        head = self.answers.read(HEAD.size)
        if len(head) < HEAD.size:
            return self.close(), b"", self._complaint()
        code, length = HEAD.unpack(head)
        return code, self.answers.read(length), self._complaint()

    def close(self):
        """The exit code of the child, which ends when nobody can ask any more."""
        if self.process is None:
            return 0
        os.close(self.tasks)
        self.answers.close()
        _, status = os.waitpid(self.process, 0)
        self.process = None
        return os.waitstatus_to_exitcode(status)

    def _complaint(self):
        with open(self.complaints, "r+b") as file:
            text = file.read()
            file.truncate(0)
        return text

    def _start(self):
        tasks, self.tasks = os.pipe()
        receiver, answers = os.pipe()
        self.answers = os.fdopen(receiver, "rb")
        self.process = os.fork()
        if self.process:
            os.close(tasks)
            os.close(answers)
            return
        os.close(self.tasks)
        self.answers.close()
        os.dup2(os.open(self.complaints, os.O_WRONLY | os.O_CREAT | os.O_APPEND), 2)
        out = os.fdopen(answers, "wb")
        for line in os.fdopen(tasks, "rb"):
            code, content = 0, b""
            try:
                content = colmap_child.encoded(colmap_child.model_arrays(json.loads(line)))
            except Exception:
                os.write(2, traceback.format_exc().encode(errors="replace"))
                code = 1
            out.write(HEAD.pack(code, len(content)))
            out.write(content)
            out.flush()
        os._exit(0)
