"""A little of each sweep; `python -m tests.adversarial.pairs` and its like run all."""

import signal

import pytest

from tests.adversarial import disk_full, interrupts, pairs

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["train, train", "eval, eval"])
def test_two_at_once(name):
    pair = next(pair for pair in pairs.PAIRS if pair.name == name)
    record = pairs.try_pair(pair, 0)
    assert not record["faults"], record


FULL = {"train": 60, "eval": 500}  # target -> times its step


@pytest.fixture(scope="module")
def place():
    with disk_full.Workplace(target for target in disk_full.TARGETS if target.name in FULL) as made:
        yield made


@pytest.mark.skipif(disk_full.can_mount() is not None, reason=str(disk_full.can_mount()))
@pytest.mark.parametrize("name, coarser", FULL.items())
def test_full_disk(place, name, coarser):
    target = next(target for target in disk_full.TARGETS if target.name == name)
    target = disk_full.Target(**{**vars(target), "step": coarser * target.step})
    records = list(disk_full.sweep(place, target))
    assert len(records) > 1 and not [each for each in records if each["faults"]], records


def interrupted(name):
    return next(target for target in interrupts.TARGETS if target.name == name)


def test_interrupted_train():
    target = interrupts.Target(**{**vars(interrupted("train")), "moments": 1, "others": 1})
    records = list(interrupts.moments(target, 0))
    assert len(records) == 3 and not [each for each in records if each["faults"]], records


def test_interrupted_eval():
    """Amid its work; Ctrl-C twice and SIGTERM are taken by the same code as a training's."""
    with interrupts.Moments(interrupted("eval")) as bench:
        record = bench.attempt("SIGINT", 0.6 * bench.seconds, ((signal.SIGINT, 0.0),))
    assert not record["faults"], record


def test_the_line_that_goes_on_is_found():
    said = "stopped after step 8; go on with: clsplat train --resume -o 'a b/run'\n"
    assert interrupts.goes_on(said, "x") == "clsplat train --resume -o 'a b/run'"
    assert interrupts.goes_on("out: stopped; the same command continues\n", "clsplat city") == (
        "clsplat city")
    assert interrupts.goes_on("interrupted\n", "x") is None
