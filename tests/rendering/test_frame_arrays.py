"""What a frame and its adjoint allocate is what is listed, to the byte."""

import numpy as np
import pytest

from clsplat.constants import FRAME_COUNTS
from clsplat.rendering.frame_arrays import STAGES, FrameArray, FrameSize, frame_arrays
from clsplat.rendering.pipeline import Room
from tests import cases
from tests.kernels.chain import camera_of, render, size_of, stored_degree
from tests.kernels.test_bands import ExactPool, live_bytes
from tests.kernels.test_pipeline import cotangents


@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("name, count", [("giants", 400), ("many", 3000), ("specks", 2000)])
@pytest.mark.parametrize("spare", [0, 100])
@pytest.mark.one_in(5)
def test_a_frame_allocates_what_is_listed(device, monkeypatch, name, count, with_depth, spare):
    """Where pairs, pixels or gaussians need most of the memory; for the frame alone, and up to the
    end of the adjoint."""
    case = cases.gaussians(name, count=count)
    renderer, rows, frame = render(device, case, with_depth=with_depth)
    room = Room(len(frame.visible) + spare, frame.pairs.count + 9 * spare)
    grads = [device.upload(values) for values in cotangents(case)[:3 if with_depth else 1]]
    counts = device.upload(np.zeros(FRAME_COUNTS, np.uint32))
    camera = renderer.pack(camera_of(case))
    del frame
    pool = ExactPool(device)
    monkeypatch.setattr(device, "_pool", pool)
    frame = renderer.render(rows, camera, *size_of(case), case["degree"], with_depth, room, counts)
    rendered = pool.most
    renderer.adjoint(rows, frame, *grads)
    size = FrameSize(count, room.visible, room.pairs, *size_of(case))
    listed = live_bytes(frame_arrays(device, size, stored_degree(case), with_depth), device.real)
    assert max(listed) == pool.most
    assert max(listed[:STAGES.index("blend") + 1]) == rendered


def test_without_a_room_the_visible_gaussians_are_listed_in_a_slot_each(device, monkeypatch):
    """The other arrays have the same sizes."""
    pool = ExactPool(device)
    monkeypatch.setattr(device, "_pool", pool)
    case = cases.gaussians("many", count=3000)
    renderer, rows, frame = render(device, case)
    renderer.adjoint(rows, frame, device.upload(cotangents(case)[0]))
    size = FrameSize(3000, len(frame.visible), frame.pairs.count, *size_of(case))
    listed = live_bytes(frame_arrays(device, size, stored_degree(case)), device.real)
    assert 0 <= pool.most - max(listed) - 4 * (3000 - len(frame.visible)) <= 128


def test_arrays_live_from_their_first_stage_to_their_last():
    arrays = [FrameArray("a", (1000,), np.uint32, "cull", "compact"),
              FrameArray("b", (2, 500), None, "compact", "adam")]
    assert live_bytes(arrays, np.dtype(np.float64)) == [4000, 12000, *12 * [8000]]
