"""python -m tests.adversarial.interrupts: Ctrl-C at random moments, from a process's start to its
end.

Each command gets SIGINT (some also a second one, or SIGTERM) at a seeded moment of its life. It
must end with exit code 130 and a line that says how to go on; what that line says is then done, and
must end in the same bytes as a run that nobody stopped, for eval in the same table.
"""

import os
import random
import re
import shutil
import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tests.adversarial.campaign import faults_of, faults_of_files, patience, run_line
from tests.adversarial.checks import rows
from tests.adversarial.prepared import ROOT, environment, provide
from tests.adversarial.sweep import arguments_of, finish
from tests.adversarial.whole import listing

COMMAND = re.compile(r"`?(clsplat (?:train|eval|city|block|merge|partition) [^`\n]*)`?")
SAME = re.compile(r"same command|again")


@dataclass(frozen=True)
class Target:
    """moments: how many for SIGINT; others: how many for each of EXTRA; result: the model that must
    have the same bytes, or the table ("")."""

    name: str
    line: str
    result: str
    moments: int
    needs: tuple[str, ...] = ("sy",)
    writes: tuple[str, ...] = ("out",)
    others: int = 2


TARGETS = (
    Target("train", "clsplat train sy -n 120 --checkpoint-every 20 -q -o out",
           "out/point_cloud.ply", 14),
    Target("eval", "clsplat eval run", "", 13, ("sy", "run"), ("run",)),
    Target("city", "clsplat city sy -n 30 --checkpoint-every 10 --grid 2x1 -q -o out",
           "out/point_cloud.ply", 13),
)
EXTRA = (  # (how, its signals, (seconds after the moment) each)
    ("SIGINT twice", ((signal.SIGINT, 0.0), (signal.SIGINT, 0.15))),
    ("SIGTERM", ((signal.SIGTERM, 0.0),)))
TAKEN_FOR_130 = (130, -signal.SIGINT)  # a shell's code of a process before Python's own handler


def before_clsplat(output: str) -> bool:
    """Whether Python itself was interrupted, before a line of clsplat's code ran."""
    return "KeyboardInterrupt" in output and f"{ROOT / 'clsplat'}{os.sep}" not in output


def goes_on(output: str, line: str) -> str | None:
    """The command that the last lines of an interrupted process name, or None."""
    for said in reversed(output.strip().splitlines()):
        found = COMMAND.search(said)
        if found:
            return found[1].rstrip(" .")
        if SAME.search(said):
            return line
    return None


class Moments:
    """Tries the moments of one target, each in a new folder."""

    def __init__(self, target):
        self.target = target

    def __enter__(self):
        self.base = Path(tempfile.mkdtemp(prefix="clsplat-int-"))
        self.folder, self.scratch = self.base / "case", self.base / "scratch"
        environment(self.scratch)
        self.fresh()
        self.run(self.target.line)  # kernels are compiled now
        self.fresh()
        result = self.run(self.target.line)
        if result.code:
            raise SystemExit(f"{self.target.line}: {result.output}")
        self.seconds, self.expected = result.seconds, self.proof(result)
        return self

    def __exit__(self, *_):
        shutil.rmtree(self.base, ignore_errors=True)

    def fresh(self):
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        provide(self.target.needs, self.folder)

    def run(self, line, signals=()):
        return run_line(line, self.folder, self.scratch, 90 * patience(), signals=signals)

    def proof(self, result):
        if not self.target.result:
            return rows(result.output)
        path = self.folder / self.target.result
        return path.read_bytes() if path.is_file() else None

    def attempt(self, how, moment, signals):
        """A record of one process that got `signals` at `moment` seconds."""
        self.fresh()
        before = listing(self.folder)
        result = self.run(self.target.line, [(moment + later, number)
                                             for number, later in signals])
        begun = listing(self.folder) != before
        faults, line = [], goes_on(result.output, self.target.line)
        if how == "SIGTERM":  # nothing is promised but that nothing is lost
            line = line or self.target.line
            faults = [each for each in faults_of(result, ()) if "exit code" not in each]
        elif before_clsplat(result.output):
            how = "SIGINT to Python"
        elif result.code in TAKEN_FOR_130:
            faults = faults_of(result, TAKEN_FOR_130)
            if result.code == 130 and not result.output.strip():
                faults.append("says nothing")
            if line is None and begun:
                faults.append("does not say how to go on")
            faults += faults_of_files(self.folder, before, self.target.writes)
        else:
            faults = faults_of(result, (0,))
        again = None
        if result.code:
            again = self._go_on(line or self.target.line, faults)
        if self.proof(again or result) != self.expected:
            faults.append("not the same result as without an interrupt")
        return {"case": self.target.name, "how": how, "moment": f"{moment:.2f} s",
                "exits": [result.code] + ([again.code] if again else []), "line": line or "",
                "faults": faults, "output": (result.output[-900:] + "\n---\n"
                                             + (again.output[-900:] if again else ""))}

    def _go_on(self, line, faults):
        """The Result of what goes on; for a training that had not begun, of the first command."""
        again = self.run(line)
        if again.code and "--resume" in line and not (self.folder / "out/options.json").exists():
            faults.append(f"said `{line}`, which does not work")
        faults += [f"going on: {each}" for each in faults_of(again, (0,))]
        return again


def moments(target, seed):
    """A record for each moment of a target, then for the other signals."""
    rng = random.Random(f"{seed} {target.name}")
    with Moments(target) as bench:
        for number in range(target.moments):  # one in each part of its life
            share = (number + rng.random()) / target.moments
            yield bench.attempt("SIGINT", share * bench.seconds, ((signal.SIGINT, 0.0),))
        for how, signals in EXTRA:
            for _ in range(target.others):
                yield bench.attempt(how, rng.uniform(0.3, 0.9) * bench.seconds, signals)


def main(words=None):
    """Try all moments; the number of those with faults."""
    arguments = arguments_of("interrupts", __doc__, words,
                             moments={"type": int, "help": "so many a command"})
    chosen = [target for target in TARGETS if not arguments.name or target.name in arguments.name]
    if arguments.moments:
        chosen = [Target(**{**vars(target), "moments": arguments.moments}) for target in chosen]
    return finish((record for target in chosen for record in moments(target, arguments.seed)),
                  arguments, ("case", "how", "moment", "exits", "line"))


if __name__ == "__main__":
    sys.exit(1 if main() else 0)
