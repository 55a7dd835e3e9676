"""Numbers that host and kernels share stand in one table, and arrive in kernels as they are."""

import re

import numpy as np
import pytest

from clsplat.constants import SHARED
from clsplat.device import Kernel, items
from tests.layout import ROOT, sources

KERNELS = {name: path.read_text() for name, path in sources(ROOT, "cl", suffixes=(".cl", ".h"))}
CODE = {name: re.sub("//.*", "", text) for name, text in KERNELS.items()}


@pytest.mark.parametrize("name", SHARED)
def test_kernels_use_each_number_and_do_not_repeat_it(name):
    assert any(re.search(rf"\b{name}\b", text) for text in CODE.values()), "host alone uses it"
    again = re.compile(rf"#define {name}\b|\b{name}\s*=[^=]|-D{name}=")
    assert [file for file, text in CODE.items() if again.search(text)] == []


def test_no_module_repeats_a_name_of_the_table():
    assigned = re.compile(r"(?m)^ *((?:[A-Z_0-9]+, )*[A-Z_0-9]+)(?:: [^=\n]+)? = ")
    for name, path in sources(ROOT, "clsplat", "tools"):
        found = {each for names in assigned.findall(path.read_text("utf-8")) for each in names.split(", ")}
        assert not found & SHARED.keys() or name == "clsplat/constants.py", name


def test_kernels_see_the_very_numbers(device, tmp_path):
    lines = [f"values[{place}] = {name};" for place, name in enumerate(SHARED)]
    file = tmp_path / "numbers.cl"
    file.write_text(f"""#include "real.h"
__kernel void numbers(__global real *values)
{{
    {" ".join(lines)}
}}
""")
    kernel = Kernel(str(file), "numbers", items("1"), values=("real", len(SHARED)))
    values = device.empty(len(SHARED))
    device.launch(kernel, values=values)
    assert np.array_equal(values.download(), np.array(list(SHARED.values()), device.real))
