"""The counters of a device: kernels and fills, waits (a copy from or to the host is one), arrays."""

import numpy as np
import pytest

from clsplat.primitives.gather import gather


@pytest.mark.parametrize(
    "work, expected",
    [
        (lambda device: device.empty(3), (0, 0, 1)),
        (lambda device: device.allocate(3), (0, 0, 1)),
        (lambda device: device.zeros(3), (1, 0, 1)),
        (lambda device: device.upload(np.zeros(3)), (0, 1, 1)),
        (lambda device: device.zeros(3).download(), (1, 1, 1)),
        (lambda device: device.zeros(0).download(), (0, 0, 1)),
        (lambda device: device.zeros(3).write(np.ones(2)), (1, 1, 1)),
        (lambda device: device.zeros((3, 2)).narrow(2).reshaped(4), (1, 0, 1)),
        (lambda device: device.finish(), (0, 1, 0)),
    ],
    ids=["empty", "allocate", "zeros", "upload", "download", "nothing", "write", "narrow", "finish"],
)
def test_each_way_of_using_the_queue_is_counted(item_device, work, expected):
    assert counted(item_device, lambda: work(item_device)) == expected


def test_a_kernel_is_counted_unless_it_has_no_work(item_device):
    source = item_device.zeros((5, 2))
    rows, into = item_device.zeros(3, np.uint32), item_device.empty((3, 2))
    assert counted(item_device, lambda: gather(item_device, source, rows, into)) == (1, 0, 0)
    assert counted(item_device, lambda: gather(item_device, source, rows.narrow(0), into.narrow(0))) == (0, 0, 0)


def counted(device, work):
    """(launches, waits, allocations) of `work()`."""
    before = device.launches, device.waits, device.allocations
    work()
    after = device.launches, device.waits, device.allocations
    return tuple(now - then for now, then in zip(after, before))
