"""Which gaussians a camera sees, around the sizes of groups and chunks; what is seen of every case
is in test_project.py."""

import numpy as np
import pytest

from clsplat.primitives import compact as module
from clsplat.primitives.compact import chunk_size
from clsplat.rendering.cull import cull
from clsplat.rendering.project import pack_camera
from tests import cases
from tests.kernels.chain import camera_of, upload_rows
from tests.reference.project import project


def culled(device, case):
    """Flags and totals."""
    defines = (("SH_REST", case["rows"]["sh_rest"].shape[1]), ("ANTIALIASED", 0))
    camera = pack_camera(device, camera_of(case), case["near"])
    return cull(device, upload_rows(device, case["rows"]), camera, defines)


def check(device, case, what):
    expected = project(case["rows"], case["camera"], case["degree"], case["near"])["visible"]
    flags, totals = culled(device, case)
    assert np.array_equal(flags.download(), expected), what
    chunk = chunk_size(device, len(expected))
    sums = [expected[first : first + chunk].sum() for first in range(0, len(expected), chunk)]
    assert np.array_equal(totals.download(), sums), what
    return expected


@pytest.mark.oclgrind
def test_counts_around_group_and_chunk_sizes(device, monkeypatch):
    monkeypatch.setattr(device, "scan_group", 4)
    monkeypatch.setattr(module, "SMALLEST_CHUNK", 32)
    monkeypatch.setattr(device, "compute_units", 1)
    for count in (0, 1, 31, 32, 33, 64, 103):
        check(device, cases.gaussians("degree_1", count=count), f"{count} gaussians")
