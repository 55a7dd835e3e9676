"""Devices that can do less than those of the tests: forced, and every launch held to it."""

import numpy as np
import pyopencl as cl
import pytest

from clsplat.bench.selftest import check
from clsplat.device import Device, capabilities, device
from clsplat.device.kernel import Kernel
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_training import CITY, trained

LOCAL_BYTES = 32 << 10  # that every device has
MULTIPLE = cl.kernel_work_group_info.PREFERRED_WORK_GROUP_SIZE_MULTIPLE
# name -> lanes that run in step, work-items of a group at most, whether optional features work,
# bytes of a buffer at most
LIMITS = {
    "all of them": (64, 100, False, 1 << 21),
    "64 lanes": (64, 256, True, 0),
    "64 lanes, groups of 64": (64, 64, True, 0),
    "32 lanes, groups of 64": (32, 64, True, 0),
    "groups of 100": (32, 100, True, 0),
    "no double, no native functions": (32, 256, False, 0),
    "buffers of 2 MiB": (32, 256, True, 1 << 21),
}


@pytest.fixture(params=LIMITS)
def limited(request, monkeypatch):
    """Forces limits on all devices that are opened; returns the local memory of each kernel that
    is built, and the sizes of the groups of all launches."""
    lanes, items, able, buffer = LIMITS[request.param]
    probe, bind, build, room = (capabilities.probe_capabilities, Kernel.bind, Device._build, Device._limited)
    local, groups = {}, set()

    def bound(kernel, on, values, defines):
        arguments, count, group = bind(kernel, on, values, defines)
        groups.add(group)
        assert group <= items, kernel.function
        return arguments, count, group

    def built(on, kernel, defines):
        found = build(on, kernel, defines)
        local[kernel.function] = found.get_work_group_info(cl.kernel_work_group_info.LOCAL_MEM_SIZE, on.handle)
        return found

    def limited_size(on, size):
        assert not buffer or size <= buffer
        return room(on, size)

    monkeypatch.setattr(cl.Device, "max_work_group_size", property(lambda handle: items))
    if buffer:
        monkeypatch.setattr(cl.Device, "max_mem_alloc_size", property(lambda handle: buffer))
    monkeypatch.setattr(device, "probe_wave", lambda *_: lanes)
    monkeypatch.setattr(
        device, "probe_capabilities", lambda *args: {name: able and works for name, works in probe(*args).items()}
    )
    monkeypatch.setattr(Kernel, "bind", bound)
    monkeypatch.setattr(Device, "_build", built)
    monkeypatch.setattr(Device, "_limited", limited_size)
    return local, groups


@pytest.mark.slow
@pytest.mark.one_in(7)
def test_the_self_test_passes_under_limits(limited, item_device):
    local, groups = limited
    assert [line for line in check(item_device) if not line[1]] == []
    assert 0 < max(local.values()) <= LOCAL_BYTES and len(groups) > 1


@pytest.mark.nightly
@pytest.mark.parametrize("form", ["item", "group"])
def test_a_small_training_ends_under_limits(limited, item_device, tmp_path, form):
    local, _ = limited
    run = trained(
        tmp_path / "run",
        read_scene(CITY),
        Device(item_device.handle, form=form),
        exposure="on",
        iterations=60,
        densify_until=50,
        reset_every=30,
        sh_every=15,
    )
    assert np.isfinite(run.load_model().positions).all()
    assert max(local.values()) <= LOCAL_BYTES


@pytest.mark.parametrize(
    "multiple, gpu, lanes", [(8, True, 32), (16, True, 32), (32, True, 32), (64, True, 64), (64, False, 32)]
)
def test_lanes_that_run_in_step(monkeypatch, multiple, gpu, lanes):
    class Built:
        def get_work_group_info(self, kind, handle):
            assert kind == MULTIPLE
            return multiple

    class Handle:
        type = cl.device_type.GPU if gpu else cl.device_type.CPU

    monkeypatch.setattr(capabilities, "_built", lambda context, work: Built())
    assert capabilities.probe_wave(None, Handle()) == lanes
