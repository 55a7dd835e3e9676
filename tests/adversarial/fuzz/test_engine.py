"""The engine notices what it is there for: each reader here is wrong in one way."""

import os
import signal
import tempfile
import time

import numpy as np
import pytest

from clsplat.errors import InputError
from tests.adversarial.fuzz import engine
from tests.adversarial.fuzz.engine import fuzz, mutation
from tests.adversarial.fuzz.readers import READERS, Reader

SEED = b"a valid file"
COUNT = 6


def made(folder):
    (folder / "seed").mkdir()
    (folder / "seed/file").write_bytes(SEED)
    yield folder / "seed"


def wrong(read):
    """The faults, as text, that mutations of a file bring out of `read`, called with its path."""
    def read_folder(folder):
        if (folder / "file").read_bytes() != SEED:
            read(folder / "file")
    outcome = fuzz(Reader(made, read_folder), COUNT)
    changed = [case for case in range(COUNT)
               if mutation(Reader(made, read), [{"file": SEED}], 0, case)[2] != SEED]
    assert [case for case, _ in outcome.faults] == changed, "each case is blamed for its own"
    assert outcome.accepted == COUNT - len(changed) and outcome.refused == 0
    return {text for _, text in outcome.faults}


def refuse(message):
    def read(path):
        raise InputError(message)
    return read


def greedy(path):
    try:
        np.ones(1 << 28)
    except MemoryError:
        raise InputError(f"{path}: damaged; copy it again") from None


@pytest.mark.slow
@pytest.mark.parametrize("read, words", [
    (lambda path: {}["x"], "KeyError"),
    (lambda path: os.kill(os.getpid(), signal.SIGABRT), "SIGABRT"),
    (lambda path: os.kill(os.getpid(), signal.SIGSEGV), "SIGSEGV"),
    (refuse("two\nlines"), "no clear line"),
    (refuse("x" * 2000), "no clear line"),
    (greedy, "memory"),
    (lambda path: np.float64(1) / np.zeros(1), "RuntimeWarning"),
    (lambda path: (path.parent / "half").touch(), "left files behind"),
    (lambda path: tempfile.mkstemp(), "left files behind"),
])
def test_a_fault_is_noticed(read, words):
    assert all(words in text for text in wrong(read))


@pytest.mark.slow
def test_a_hang_is_noticed(monkeypatch):
    monkeypatch.setattr(engine, "SECONDS", 0.5)
    monkeypatch.setattr(engine, "POLL_SECONDS", 0.01)
    assert all("more than" in text for text in wrong(lambda path: time.sleep(9)))


def test_a_seed_that_is_refused_is_the_engines_fault():
    with pytest.raises(RuntimeError, match="a seed is not read"):
        fuzz(Reader(made, refuse("no")), COUNT)


def test_mutations_are_told_by_their_number():
    reader = READERS["options"]
    seeds = reader.seeds()
    assert seeds == reader.seeds()
    found = [mutation(reader, seeds, 0, case) for case in range(200)]
    assert found == [mutation(reader, seeds, 0, case) for case in range(200)]
    assert len({content for _, _, content in found}) > 190
    assert found != [mutation(reader, seeds, 1, case) for case in range(200)]
