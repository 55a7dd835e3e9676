"""What a frame and its adjoint allocate is what is listed, to the byte."""

import numpy as np
import pytest

from clsplat.rendering.frame_arrays import (
    STAGES,
    FrameArray,
    FrameSize,
    by_stage,
    frame_arrays,
)
from tests import cases
from tests.kernels.chain import render, size_of, stored_degree
from tests.kernels.test_bands import ExactPool, live_bytes
from tests.kernels.test_pipeline import cotangents


@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("name, count", [("giants", 400), ("many", 3000), ("specks", 2000)])
def test_a_frame_allocates_what_is_listed(device, monkeypatch, name, count, with_depth):
    """Where pairs, pixels or gaussians need most of the memory; for the frame alone, and up to the
    end of the adjoint."""
    pool = ExactPool(device)
    monkeypatch.setattr(device, "_pool", pool)
    case = cases.gaussians(name, count=count)
    renderer, rows, frame = render(device, case, with_depth=with_depth)
    rendered = pool.most
    grads = map(device.upload, cotangents(case)[:3 if with_depth else 1])
    renderer.adjoint(rows, frame, *grads)
    size = FrameSize(count, len(frame.visible), frame.pairs.count, *size_of(case))
    listed = live_bytes(frame_arrays(device, size, stored_degree(case), with_depth), device.real)
    assert max(listed) == pool.most
    assert abs(max(listed[:STAGES.index("blend") + 1]) - rendered) <= 64


def test_arrays_live_from_their_first_stage_to_their_last():
    arrays = [FrameArray("a", (1000,), np.uint32, "cull", "compact"),
              FrameArray("b", (2, 500), None, "compact", "adam")]
    assert [array.name for array in by_stage(arrays)[1]] == ["a", "b"]
    assert live_bytes(arrays, np.dtype(np.float64)) == [4000, 12000, *13 * [8000]]
