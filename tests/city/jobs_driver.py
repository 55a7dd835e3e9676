"""Jobs of tests: a "training" of some steps that can be interrupted, goes on where it stopped, and
records its starts and ends; and `Workers.run` in a process that a test can interrupt or kill:

    python -m tests.city.jobs_driver FOLDER COUNT STEPS WORKERS [SCHEDULER]
"""

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from clsplat.cities.jobs import Job
from clsplat.cities.workers import Workers
from clsplat.errors import ClsplatError, InputError, Interrupted, OutOfDeviceMemory
from clsplat.io.lock import exclusive
from clsplat.training.interrupt import deferred_interrupt

DONE, STATE, STARTS, ENDS, STEPPED = "done.txt", "state.txt", "starts.txt", "ends.txt", "steps.txt"
NO_DEVICE = "no such device"
STEP_SECONDS = 0.05
FAULTS = {
    "refuse": InputError("as requested"),
    "memory": OutOfDeviceMemory("as requested"),
    "bug": ValueError("as requested"),
}


@dataclass(frozen=True)
class Steps(Job):
    """Some steps; the first `failures` tries end by a `fault`: of FAULTS, or a signal's number."""

    steps: int = 1
    failures: int = 0
    fault: str = "bug"
    says: str = ""

    def run(self, device, progress=None, stopping=lambda: False):
        with exclusive(self.folder, 30):
            note(
                self.folder / STARTS,
                os.getpid(),
                device.name.replace(" ", "_"),
                os.environ.get("CLSPLAT_DEVICE", "-"),
                os.environ.get("POCL_CACHE_DIR", "-"),
            )
            if self.says:
                os.write(1, f"{self.says} from {self.name}\n".encode())
            if len(lines(self, STARTS)) <= self.failures:
                if self.fault in FAULTS:
                    raise FAULTS[self.fault]
                os.kill(os.getpid(), int(self.fault))
                time.sleep(60)
            state = self.folder / STATE
            step = int(state.read_text()) if state.exists() else 0
            with deferred_interrupt() as interrupted:
                while step < self.steps and not (interrupted() or stopping()):
                    time.sleep(STEP_SECONDS)
                    step += 1
                    note(self.folder / STEPPED)
                state.write_text(str(step))
            if step < self.steps:
                raise Interrupted("saved")
            note(self.folder / ENDS)
            (self.folder / DONE).touch()
            return step


def some_jobs(folder, count, **fields):
    """Jobs 000, 001, ..., each with its folder."""
    return [
        Steps(f"{number:03d}", folder / f"{number:03d}", done=folder / f"{number:03d}" / DONE, **fields)
        for number in range(count)
    ]


def note(path, *words):
    with open(path, "a") as file:
        file.write(f"{time.time()} {' '.join(map(str, words))}\n")


def lines(job, name):
    """The lines of a file in a job's folder; none if there is no such file."""
    path = job.folder / name
    return path.read_text().splitlines() if path.exists() else []


if __name__ == "__main__":
    place, count, steps, workers, *scheduler = sys.argv[1:]
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with Workers(int(workers), *scheduler) as all_workers:
            all_workers.run(
                some_jobs(Path(place), int(count), steps=int(steps)),
                None,
                ended=lambda outcome: print(outcome.job.name, outcome.tries),
            )
    except ClsplatError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)
