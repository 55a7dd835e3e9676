"""python -m tests.adversarial.pairs: two processes at once on one folder.

Right is: one works and leaves what it leaves alone, the other is refused with a line that names the
first; or both end as they do one after the other, whichever of them was the first.
"""

import json
import random
import re
import shutil
import signal
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

from tests.adversarial.campaign import NOISE, faults_of, patience, run_line
from tests.adversarial.prepared import environment, provide
from tests.adversarial.sweep import arguments_of, finish
from tests.adversarial.whole import fault

NAMES_IT = re.compile(r"process \d+.* on \S+.* since ")
REFUSAL = re.compile("works here|trains it")
TRAIN = "clsplat train sy -n 12 --checkpoint-every 4 -q"
CITY = "clsplat city sy -n 8 --grid 2x1 -q -o city"
UNTRAINED = ("rm -r city/blocks/*/run city/point_cloud.ply city/metrics.jsonl city/lod "
             "city/options.json")


@dataclass(frozen=True)
class Pair:
    """first is started at once, second a while later; kill: first gets SIGKILL before."""

    name: str
    first: str
    second: str
    folder: str = "out"
    needs: tuple[str, ...] = ("sy",)
    setup: str = "true"
    kill: bool = False


RUN, HALF, OLD = ("sy", "run"), ("sy", "half"), ("sy", "city")
AGAIN, OVER, EVAL = (f"{TRAIN} -o run --overwrite", f"{TRAIN} --seed 1 -o run --overwrite",
                     "clsplat eval run")
RESUME, MERGE = "clsplat train sy -o half --resume -q", "clsplat merge city"
BLOCK = "clsplat block city/blocks/000 -q"
PAIRS = (
    Pair("train, train", f"{TRAIN} -o out", f"{TRAIN} --seed 1 -o out"),
    Pair("train, train --overwrite", f"{TRAIN} -o out", f"{TRAIN} --seed 1 -o out --overwrite"),
    Pair("train --overwrite twice", AGAIN, OVER, "run", RUN),
    Pair("train --overwrite, eval", AGAIN, EVAL, "run", RUN),
    Pair("eval, train --overwrite", EVAL, OVER, "run", RUN),
    Pair("eval, eval", EVAL, EVAL, "run", RUN),
    Pair("resume, resume", RESUME, RESUME, "half", HALF),
    Pair("resume, eval", RESUME, "clsplat eval half", "half", HALF),
    Pair("resume, train --overwrite", RESUME, f"{TRAIN} --seed 1 -o half --overwrite", "half",
         HALF),
    Pair("schedules twice", f"{TRAIN} --schedules sig -o out", f"{TRAIN} --schedules sig -o out"),
    Pair("city, city", CITY, CITY, "city"),
    Pair("city, city --fill", CITY, f"{CITY} --fill", "city", OLD, UNTRAINED),
    Pair("city, train into coarse", CITY, "clsplat train sy --coarse -n 8 -q -o city/coarse",
         "city"),
    Pair("city, block", CITY, BLOCK, "city", OLD, UNTRAINED),
    Pair("block, city", BLOCK, CITY, "city", OLD, UNTRAINED),
    Pair("block, block", BLOCK, BLOCK, "city", OLD, UNTRAINED),
    Pair("city, merge", CITY, f"{MERGE} --fill", "city", OLD, UNTRAINED),
    Pair("merge, city", MERGE, CITY, "city", OLD),
    Pair("merge, merge", MERGE, MERGE, "city", OLD),
    Pair("merge, eval", MERGE, "clsplat eval city", "city", OLD),
    Pair("block, merge --fill", BLOCK, f"{MERGE} --fill", "city", OLD, UNTRAINED),
    Pair("partition twice", "clsplat partition city --grid 2x1", "clsplat partition city --grid "
         "2x1", "city", OLD, UNTRAINED + " city/partition* city/blocks"),
    Pair("train killed, resume", f"{TRAIN} -o out", "clsplat train sy -o out --resume -q || "
         f"{TRAIN} -o out", kill=True),
    Pair("city killed, city", CITY, CITY, "city", kill=True),
)


def state(folder: Path) -> dict[str, object]:
    """What a folder holds, without what depends on clocks: the bytes of models and pictures, the
    events of metrics, and the names of all other files."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_dir() or path.name in NOISE:
            continue
        if path.suffix == ".ply" or path.suffix == ".png" and "renders" in name:
            found[name] = hash(path.read_bytes())
        elif path.name == "metrics.jsonl":
            records = [json.loads(line) for line in path.read_text().splitlines()]
            # evaluations on the way come by the clock
            found[name] = [(each["event"], each["iteration"]) for each in records
                           if each["event"] != "eval" or each is records[-1]]
        else:
            found[name] = fault(path)
    return found


class Bench:
    """Runs lines of a pair, each time in a new folder."""

    def __init__(self, pair):
        self.pair = pair
        self._known = {}

    def __enter__(self):
        self.base = Path(tempfile.mkdtemp(prefix="clsplat-pairs-"))
        return self

    def __exit__(self, *_):
        shutil.rmtree(self.base, ignore_errors=True)

    def folder(self):
        """A new one, with what the pair needs."""
        shutil.rmtree(self.base / "case", ignore_errors=True)
        (self.base / "case").mkdir()
        provide(self.pair.needs, self.base / "case")
        self.run(self.pair.setup)
        return self.base / "case"

    def run(self, line, delay=0.0, signals=()):
        """(Result, when it began, when it ended) of a line after `delay` seconds."""
        sleep(delay)
        begin = monotonic()
        result = run_line(line, self.base / "case", self.base / "scratch", 90 * patience(),
                          signals=signals)
        return result, begin, monotonic()

    def after(self, *lines):
        """(exit codes, state) of lines one after the other, alone."""
        if lines not in self._known:
            folder = self.folder()
            codes = [self.run(line)[0].code for line in lines]
            self._known[lines] = codes, state(folder / self.pair.folder)
        return self._known[lines]


def try_pair(pair: Pair, seed: int) -> dict:
    """A record of how a pair ended, with `faults`."""
    rng = random.Random(f"{seed} {pair.name}")
    with Bench(pair) as bench:
        environment(bench.base / "scratch")
        bench.folder()
        alone = bench.run(pair.first)[0].seconds
        offset = 0.6 * rng.random() ** 2 * alone  # many while both start
        folder = bench.folder()
        if pair.kill:
            bench.run(pair.first, signals=[(offset, signal.SIGKILL)])
            done = [bench.run(pair.second)]
        else:
            with ThreadPoolExecutor(2) as pool:
                one = pool.submit(bench.run, pair.first)
                two = pool.submit(bench.run, pair.second, offset)
                done = [one.result(), two.result()]
        left = state(folder / pair.folder)
        how, faults = _judge(bench, pair, [result for result, _, _ in done], left)
    overlap = 0.0 if pair.kill else min(d[2] for d in done) - max(d[1] for d in done)
    return {"case": pair.name, "offset": round(offset, 2), "overlap": round(overlap, 2),
            "exits": [result.code for result, _, _ in done], "how": how, "faults": faults,
            "output": "" if not faults else "\n---\n".join(d[0].output[-900:] for d in done)}


def _judge(bench, pair, results, left):
    """(how it ended, faults)."""
    # one that was killed before it wrote its options is begun again, and the line tries both
    faults = [each for result in results for each in faults_of(result, (0, 2))
              if not (pair.kill and each.startswith("exit code 0 beside an error"))]
    faults += [f"{name} was left" for name in left if name.endswith(".part")]
    faults += [f"{name}: {value}" for name, value in left.items() if isinstance(value, str)]
    if pair.kill:
        expected = bench.after(pair.first)[1]
        if {k: v for k, v in left.items() if k.endswith(".ply")} != {
                k: v for k, v in expected.items() if k.endswith(".ply")}:
            faults.append("other models than without the kill")
        return "went on after a kill", faults
    codes = [result.code for result in results]
    held = [bool(REFUSAL.search(result.output)) for result in results]
    faults += [f"does not name who holds the folder: {result.errors}" for result, refused in
               zip(results, held) if refused and not NAMES_IT.search(result.output)]
    lines = [pair.first, pair.second]
    for winner, loser in ((0, 1), (1, 0)):
        if codes[winner] == 0 and codes[loser] == 2 and held[loser]:
            if left != bench.after(lines[winner])[1]:
                faults.append(f"not as `{lines[winner]}` alone: "
                              + _difference(left, bench.after(lines[winner])[1]))
            return "refused", faults
    orders = [bench.after(*lines), bench.after(*lines[::-1])]
    for (expected, there), found in zip(orders, (codes, codes[::-1])):
        if (list(expected), there) == (found, left):
            return "one after the other", faults
    faults.append(f"exit codes {codes}, and neither as one alone nor as one after the other: "
                  + _difference(left, orders[0][1]))
    return "mixed", faults


def _difference(left, expected):
    names = sorted(name for name in {*left, *expected} if left.get(name, 0) != expected.get(name,
                                                                                           0))
    return ", ".join(names[:8]) or "the exit codes only"


def main(words=None):
    """Try the pairs; the number of those with faults."""
    arguments = arguments_of("pairs", __doc__, words)
    chosen = [pair for pair in PAIRS if not arguments.name or pair.name in arguments.name]
    return finish((try_pair(pair, arguments.seed) for pair in chosen), arguments,
                  ("case", "offset", "overlap", "exits", "how"))


if __name__ == "__main__":
    sys.exit(1 if main() else 0)
