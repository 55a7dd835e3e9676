"""Every reader against mutated files: a table, and exit 1 after a fault.

    python -m tests.adversarial.fuzz [READER...] --count 20000 --seed 0
    python -m tests.adversarial.fuzz READER --case N

The second leaves the folder of one case behind and reads it.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.adversarial.fuzz.engine import fuzz, mutation, write_seed
from tests.adversarial.fuzz.readers import READERS

SHOWN = 10  # faults a reader
ROW = "{:<12} {:>7} {:>9} {:>8} {:>9} {:>9} {:>7} {:>8}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("readers", nargs="*", metavar="READER", help=", ".join(READERS))
    parser.add_argument("--count", type=int, default=20000, help="mutated inputs a reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--case", type=int, help="only this one, in this process")
    given = parser.parse_args()
    chosen = {name: READERS[name] for name in given.readers or READERS}
    if given.case is not None:
        for reader in chosen.values():
            read_one(reader, given.seed, given.case)
        return 0
    print(ROW.format("reader", "cases", "accepted", "refused", "worst, s", "peak, MB", "faults",
                     "took, s"))
    faults = 0
    for name, reader in chosen.items():
        begin = time.monotonic()
        outcome = fuzz(reader, given.count, given.seed, given.workers)
        faults += len(outcome.faults)
        print(ROW.format(name, outcome.cases, outcome.accepted, outcome.refused,
                         f"{outcome.seconds:.2f}", f"{outcome.peak_bytes / 1e6:.0f}",
                         len(outcome.faults), f"{time.monotonic() - begin:.0f}"))
        for case, fault in outcome.faults[:SHOWN]:
            print(f"  case {case}: {fault}")
        sys.stdout.flush()
    return 1 if faults else 0


def read_one(reader, seed, case):
    seeds = reader.seeds()
    at, name, content = mutation(reader, seeds, seed, case)
    folder = write_seed({**seeds[at], name: content}, Path(tempfile.mkdtemp(prefix="clsplat-")))
    print(f"{folder}: {name} is mutated")
    reader.read(folder)


if __name__ == "__main__":
    sys.exit(main())
