"""The engine in a process that a test can interrupt or kill:

    python -m tests.distribute.driver FOLDER COUNT STEPS WORKERS [SCHEDULER]
"""

import sys
from pathlib import Path

from clsplat.distribute import Task, run
from clsplat.errors import ClsplatError
from tests.distribute import stub_command

PROGRAM = "tests.distribute.stub_command"


def stub_tasks(folder, count, *words):
    """Tasks of the stub, each with its folder."""
    return [Task(f"{number:03d}", (str(folder / f"{number:03d}"), *map(str, words)),
                 folder / f"{number:03d}" / stub_command.DONE) for number in range(count)]


if __name__ == "__main__":
    place, count, steps, workers, *scheduler = sys.argv[1:]
    try:
        run(stub_tasks(Path(place), int(count), "--steps", steps), int(workers), *scheduler,
            program=PROGRAM, progress=print)
    except ClsplatError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)
