"""Every reader against seeded mutations; `python -m tests.adversarial.fuzz` takes other numbers.

In a process of its own: the workers are forked, and OpenCL's threads would not survive that.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.adversarial.fuzz.readers import READERS

ROOT = Path(__file__).resolve().parents[3]


def fuzzed(*words, seconds):
    """Run the command; its table, when nothing but clear errors came of it."""
    done = subprocess.run([sys.executable, "-m", "tests.adversarial.fuzz", *map(str, words)],
                          cwd=ROOT, capture_output=True, text=True, timeout=seconds, check=False)
    assert done.returncode == 0, f"\n{done.stdout}{done.stderr}"
    rows = [line.split() for line in done.stdout.splitlines()[1:]]
    assert [row[0] for row in rows] == list(READERS)
    for _, cases, accepted, refused, *_ in rows:
        assert int(accepted) > 0 and int(refused) > 0, "both kinds of input are reached"
        assert int(accepted) + int(refused) == int(cases)
    return done.stdout


@pytest.mark.slow
def test_mutations():
    """`python -m tests.adversarial.fuzz --count 20000` is the long way."""
    fuzzed("--count", 40, "--seed", 1, seconds=3600)
