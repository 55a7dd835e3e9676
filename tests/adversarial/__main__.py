"""python -m tests.adversarial: runs the hostile cases, and prints what failed and a table."""

import argparse
import json
import signal
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

from tests.adversarial.campaign import run_case
from tests.adversarial.cases import CLASSES
from tests.adversarial.prepared import prepared


def chosen(arguments):
    """[(class, Case), ...] that the command line asks for."""
    rows = [(label, case) for label, cases in CLASSES.items() for case in cases
            if not arguments.label or label in arguments.label]
    rows = [row for row in rows if not arguments.name or row[1].name in arguments.name]
    rows = [row for row in rows if row[1].quick or not arguments.quick]
    return rows[arguments.part % arguments.every::arguments.every]


def table(rows, failed):
    """Cases and failures by class, as text."""
    tried = Counter(label for label, _ in rows)
    lines = [f"{'class':<16}{'tried':>7}{'failed':>8}"]
    lines += [f"{label:<16}{count:>7}{failed[label]:>8}" for label, count in tried.items()]
    return "\n".join([*lines, f"{'all':<16}{len(rows):>7}{sum(failed.values()):>8}"])


def main(words=None):
    """Run the cases that `words` choose; the number of those that failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.adversarial", description=__doc__)
    parser.add_argument("--class", dest="label", action="append", choices=list(CLASSES))
    parser.add_argument("--name", action="append", help="only the case of this name")
    parser.add_argument("--quick", action="store_true", help="only those that pytest runs")
    parser.add_argument("--every", type=int, default=1, help="only one case of so many")
    parser.add_argument("--part", type=int, default=0, help="with --every: which of them")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", help="file for one record a line")
    parser.add_argument("--list", action="store_true", help="say which cases there are")
    arguments = parser.parse_args(words)
    rows = chosen(arguments)
    if arguments.list:
        for label, case in rows:
            print(f"{label:<14}{case.name:<34}{case.line!r}")
        return 0
    prepared()
    failed, records = Counter(), open(arguments.json, "w") if arguments.json else None
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what runs is ended too
    with ThreadPoolExecutor(arguments.jobs) as pool:
        each = pool.map if arguments.jobs > 1 else map
        for (label, case), (result, faults) in zip(rows, each(lambda row: run_case(row[1]), rows)):
            print(f"{'FAILED' if faults else 'passed'} {label} {case.name} "
                  f"({result.seconds:.0f} s)", flush=True)
            if faults:
                failed[label] += 1
                print(f"  $ {case.line}", *(f"  - {each}" for each in faults[:12]), sep="\n")
                print("    | " + result.output[-1500:].replace("\n", "\n    | "), flush=True)
            if records:
                print(json.dumps({"class": label, "case": case.name, "line": case.line,
                                  "exit": result.code, "seconds": round(result.seconds, 1),
                                  "faults": faults}), file=records, flush=True)
    print(table(rows, failed))
    return sum(failed.values())


if __name__ == "__main__":
    sys.exit(1 if main() else 0)
