"""`clsplat` in a process that ends itself as `kill -9` does, at a chosen moment:

    python -m tests.adversarial.kill MOMENT N WORDS...

dies at the N-th time that MOMENT comes; WORDS are the command line's. N.F, of a moment that is a
stretch of time, dies about 0.F seconds after its N-th beginning, wherever the process is then.
"""

import os
import signal
import sys
import threading

import numpy as np

from clsplat.cli.main import main
from clsplat.io.runs.run import METRICS, RunFolder
from clsplat.optimise.adam import DeviceAdam
from clsplat.training import recorder
from clsplat.training.step import Step

# moment -> what is called then; "after": once it has returned
BEFORE = {
    "step": (Step, "run"),
    "growth": (DeviceAdam, "regrow"),  # the rows have grown, their moments have not
    "checkpoint": (np.lib.format, "write_array"),  # the arrays before it are in the file
    "rename": (os, "replace"),
    "evaluation": (recorder, "evaluate_views"),
    "model": (RunFolder, "save_model"),
    "record": (RunFolder, "log"),
}
AFTER = {"renamed": (os, "replace"), "saved": (RunFolder, "save_checkpoint")}


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def half_a_line(run, *_):
    with open(run.path / METRICS, "ab") as file:
        file.write(b'{"event": "step", "iter')
    die()


def arm(moment, number):
    """Die when `moment` comes for the `number`-th time."""
    owner, name = {**BEFORE, **AFTER}[moment]
    original, calls = getattr(owner, name), []
    nth, _, fraction = number.partition(".")

    def call(*arguments, **named):
        calls.append(1)
        due = len(calls) == int(nth)
        if due and fraction:
            threading.Timer(float("0." + fraction), die).start()
        elif due and moment == "record":
            half_a_line(*arguments)
        elif due and moment in BEFORE:
            die()
        result = original(*arguments, **named)
        if due and moment in AFTER:
            die()
        return result

    setattr(owner, name, call)


if __name__ == "__main__":
    arm(*sys.argv[1:3])
    main(sys.argv[3:])
