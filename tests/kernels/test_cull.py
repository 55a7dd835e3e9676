"""Which gaussians a camera sees: those whose footprint meets the image."""

import numpy as np
import pytest

from clsplat.primitives import compact as module
from clsplat.primitives.compact import chunk_size
from clsplat.rendering.cull import cull
from clsplat.rendering.project import pack_camera
from tests import cases
from tests.kernels.chain import camera_of, upload_rows
from tests.reference.project import project

ANTIALIASED = ("degree_0", "plain", "needles", "opacities", "specks")
CASES = [(name, False) for name in cases.SCENES] + [(name, True) for name in ANTIALIASED]


def culled(device, case, antialiased=False):
    """Flags and totals."""
    defines = (("SH_REST", case["rows"]["sh_rest"].shape[1]), ("ANTIALIASED", int(antialiased)))
    camera = pack_camera(device, camera_of(case), case["near"])
    return cull(device, upload_rows(device, case["rows"]), camera, defines)


def check(device, case, antialiased, what):
    expected = project(case["rows"], case["camera"], case["degree"], case["near"],
                       antialiased=antialiased)["visible"]
    flags, totals = culled(device, case, antialiased)
    assert np.array_equal(flags.download(), expected), what
    chunk = chunk_size(device, len(expected))
    sums = [expected[first:first + chunk].sum() for first in range(0, len(expected), chunk)]
    assert np.array_equal(totals.download(), sums), what
    return expected


@pytest.mark.parametrize("name, antialiased", CASES)
@pytest.mark.one_in(5)
def test_the_reference_sees_the_same(device, name, antialiased):
    check(device, cases.gaussians(name), antialiased, name)


@pytest.mark.oclgrind
def test_counts_around_group_and_chunk_sizes(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", 4)
    monkeypatch.setattr(module, "SMALLEST_CHUNK", 32)
    monkeypatch.setattr(device, "compute_units", 1)
    for count in (0, 1, 31, 32, 33, 64, 103):
        check(device, cases.gaussians("degree_1", count=count), False, f"{count} gaussians")
