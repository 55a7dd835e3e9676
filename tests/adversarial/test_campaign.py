"""The quick hostile cases; `python -m tests.adversarial` runs all."""

import pytest

from tests.adversarial.campaign import run_case
from tests.adversarial.cases import CLASSES

QUICK = [pytest.param(case, id=f"{label}-{case.name}") for label, cases in CLASSES.items()
         for case in cases if case.quick]


def test_names_are_unique():
    names = [case.name for cases in CLASSES.values() for case in cases]
    assert len(set(names)) == len(names) >= 250


@pytest.mark.slow
@pytest.mark.parametrize("case", QUICK)
def test_hostile_case(case):
    result, faults = run_case(case)
    assert not faults, "\n".join([case.line, *faults, result.output[-2000:]])
