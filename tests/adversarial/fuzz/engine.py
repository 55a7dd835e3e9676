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
import tempfile
import time
import traceback
import warnings
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.scenes.checks import CONTROL
from tests.adversarial.fuzz.mutate import mutated

SECONDS = 60  # a case that takes longer hangs, also where other processes take most of the time
MEMORY_BYTES = 512 << 20  # a reader may take so much more than its process had
POLL_SECONDS = 0.02
LONGEST = 1000  # characters of a message
CASE, STARTED, ACCEPTED, REFUSED, WORST, PEAK, END = range(7)  # a worker's row in shared memory


@dataclass
class Outcome:
    """seconds: of the slowest case; peak_bytes: most that a worker held; faults:
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
            with suppress(OSError):  # the folder is gone where another worker has failed before
                (folder / "failure").write_text(traceback.format_exc())
        finally:
            os._exit(1)
    running[process] = cases, row, folder


def _look_at(process, reader, seeds, seed, running, outcome):
    """Reap a worker that ended, or end one that hangs, and go on behind its case."""
    cases, row, folder = running[process]
    ended, status = os.waitpid(process, os.WNOHANG)
    if not ended:
        if time.monotonic() - row[STARTED] < SECONDS:
            return
        os.kill(process, signal.SIGKILL)
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
    shutil.rmtree(folder / "scratch", ignore_errors=True)  # of a worker that died
    places = [write_seed(content, folder / str(at)) for at, content in enumerate(seeds)]
    known = {place / name for place, content in zip(places, seeds) for name in content}
    scratch = folder / "scratch"
    scratch.mkdir()
    tempfile.tempdir = str(scratch)
    warnings.simplefilter("error", RuntimeWarning)  # numpy's: a reader says what is wrong itself
    _limit_memory()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng tells stderr all that it meets
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
    row[PEAK] = max(row[PEAK], 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


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
