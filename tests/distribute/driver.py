"""The engine in a process that a test can interrupt or kill:

    python -m tests.distribute.driver FOLDER COUNT STEPS WORKERS [SCHEDULER]
"""

import sys
import threading
from pathlib import Path

from clsplat.distribute import Task, run
from clsplat.errors import ClsplatError
from tests.distribute import stub_command

PROGRAM = "tests.distribute.stub_command"


def stub_tasks(folder, count, *words):
    """Tasks of the stub, each with its folder."""
    return [Task(f"{number:03d}", (str(folder / f"{number:03d}"), *map(str, words)),
                 folder / f"{number:03d}" / stub_command.DONE) for number in range(count)]


def lines(task, name):
    """The lines of a file in a task's folder; none where there is no such file."""
    path = task.folder / name
    return path.read_text().splitlines() if path.exists() else []


def processes_of(tasks):
    """The process of each task's last start."""
    return [lines(task, stub_command.STARTS)[-1].split()[-1] for task in tasks]


def wait_for_ever():
    """As a child does that opens a device which does not answer."""
    threading.Event().wait()


if __name__ == "__main__":
    place, count, steps, workers, *scheduler = sys.argv[1:]
    try:
        run(stub_tasks(Path(place), int(count), "--steps", steps), int(workers), *scheduler,
            program=PROGRAM, progress=print)
    except ClsplatError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)
