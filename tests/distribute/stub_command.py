"""Stands for `clsplat` in tests of the engine: a "training" of some steps that can be interrupted,
continues where it stopped, and records its starts and ends.

    python -m tests.distribute.stub_command FOLDER [--steps N] [--fail N] [--code N] [--forget]
        [--say TEXT]

fails the first --fail times with exit code --code; a negative one is a signal. On the device
NO_DEVICE, it refuses.
"""

import argparse
import os
import sys
import time
from pathlib import Path

DONE, STATE, STARTS, ENDS = "done.txt", "state.txt", "starts.txt", "ends.txt"
STEPPED = "stepped.txt"  # has a line for each start after which a step was made
NO_DEVICE = "no such device"
STEP_SECONDS, SAVE_SECONDS = 0.05, 0.1


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=1)
    parser.add_argument("--fail", type=int, default=0)
    parser.add_argument("--code", type=int, default=1)
    parser.add_argument("--forget", action="store_true", help="do not write DONE")
    parser.add_argument("--say", default="")
    options = parser.parse_args()
    folder, state = options.folder, options.folder / STATE
    seen = [os.environ.get(name, "-") for name in ("CLSPLAT_DEVICE", "POCL_CACHE_DIR")]
    note(folder / STARTS, os.getppid(), *seen, os.getpid())
    if options.say:
        print(f"{options.say} from {folder.name}")
    if NO_DEVICE in seen:
        sys.exit(2)
    if len((folder / STARTS).read_text().splitlines()) <= options.fail:
        print("error: as requested", file=sys.stderr, flush=True)
        if options.code < 0:
            os.kill(os.getpid(), -options.code)
        sys.exit(options.code)
    step = begun = int(state.read_text()) if state.exists() else 0
    try:
        while step < options.steps:
            time.sleep(STEP_SECONDS)
            step += 1
            if step == begun + 1:
                note(folder / STEPPED)
    finally:  # as a training that is interrupted once saves its state
        time.sleep(SAVE_SECONDS)
        state.write_text(str(step))
    note(folder / ENDS)
    if not options.forget:
        (folder / DONE).touch()


def note(path, *words):
    with open(path, "a") as file:
        file.write(f"{time.time()} {' '.join(map(str, words))}\n")


if __name__ == "__main__":
    main()
