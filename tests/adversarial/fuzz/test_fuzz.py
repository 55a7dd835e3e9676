"""Every reader against mutated files, in processes that may die: the nightly campaign.

CLSPLAT_FUZZ_SEED and CLSPLAT_FUZZ_COUNT choose others than today's, and how many a reader.
"""

import datetime
import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.adversarial.fuzz.readers import READERS

ROOT = Path(__file__).resolve().parents[3]
SEED = os.environ.get("CLSPLAT_FUZZ_SEED") or datetime.date.today().isoformat()
COUNT = int(os.environ.get("CLSPLAT_FUZZ_COUNT", "300"))


def outcomes(name, first, last):
    """(case, "read", "refused" or the fault) of each; a fatal case ends a process, not all."""
    while first < last:
        done = subprocess.run(
            [sys.executable, "-m", "tests.adversarial.fuzz", name, SEED, str(first), str(last)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        rows = [json.loads(line) for line in done.stdout.splitlines()]
        assert rows, f"{name}: its valid files are not read\n{done.stdout}{done.stderr}"
        yield from (row for row in rows if row[1] != "begun")
        first = rows[-1][0] + 1
        if rows[-1][1] == "begun":
            yield rows[-1][0], f"the process ended with {done.returncode}"


@pytest.mark.nightly
@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_read_or_refused_in_one_line(name):
    rows = list(outcomes(name, 0, COUNT))
    faults = [
        f"python -m tests.adversarial.fuzz {name} {SEED} {case} 0 --keep: {said}"
        for case, said in rows
        if said not in ("read", "refused")
    ]
    assert not faults, "\n".join(faults[:10])
    assert len(rows) == COUNT and len(Counter(said for _, said in rows)) == 2, "both are reached"
