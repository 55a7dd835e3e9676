"""What the sweeps share: their command line, and how they tell what they found."""

import argparse
import json

from tests.adversarial.prepared import prepared


def arguments_of(name, doc, words, **more):
    """The parsed command line of a sweep; more: option -> keywords of `add_argument`."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.adversarial.{name}", description=doc,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--name", action="append", help="only the case of this name")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", help="file for one record a line")
    for option, keywords in more.items():
        parser.add_argument(f"--{option}", **keywords)
    arguments = parser.parse_args(words)
    prepared()
    return arguments


def finish(records, arguments, columns):
    """Print the records as they come, with their faults; returns how many have some."""
    failed = tried = 0
    file = open(arguments.json, "w") if arguments.json else None
    print("  ".join(columns))
    for record in records:
        tried += 1
        failed += bool(record["faults"])
        print("FAILED" if record["faults"] else "passed",
              "  ".join(str(record[column]) for column in columns), flush=True)
        for fault in record["faults"]:
            print(f"  - {fault}", flush=True)
        if record["faults"]:
            print("    | " + record.get("output", "").replace("\n", "\n    | "), flush=True)
        if file:
            print(json.dumps(record), file=file, flush=True)
    print(f"{tried} tried, {failed} failed")
    return failed
