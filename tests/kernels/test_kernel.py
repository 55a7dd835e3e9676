"""Contracts of kernels: what does not fit is refused, and the message names it."""

import numpy as np
import pytest

from clsplat.device import Device, Kernel
from clsplat.errors import DeviceError, ShapeError
from clsplat.primitives.gather import GATHER
from clsplat.primitives.scan import exclusive_scan

TYPES = {name: kind for name, kind in GATHER.arguments.items()}


@pytest.fixture
def call(float_device):
    """Launches `gather` with good arguments, some replaced."""
    good = {"count": 4, "width": 3, "indices": float_device.zeros(4, np.uint32),
            "rows": float_device.zeros((9, 3)), "result": float_device.zeros((4, 3))}

    def launch(**changes):
        float_device.launch(GATHER, 12, **{**good, **changes})
    return launch


def test_good_arguments_are_taken(call):
    call()


@pytest.mark.parametrize("name, shape, dtype", [
    ("rows", (9, 4), None), ("rows", (9,), None), ("indices", (5,), np.uint32),
    ("indices", (4,), np.int32), ("result", (4, 3), np.uint32), ("rows", (9, 3), np.float64)])
def test_a_wrong_array_is_named(call, float_device, name, shape, dtype):
    # where lengths disagree, it is the later of the two arguments that does not fit
    blamed = "result" if shape in ((9, 4), (5,)) else name
    with pytest.raises(ShapeError, match=f"gather in gather.cl: '{blamed}'"):
        call(**{name: float_device.zeros(shape, dtype)})


def test_unknown_and_missing_arguments_are_named(call, float_device):
    with pytest.raises(ShapeError, match="colour"):
        call(colour=1)
    with pytest.raises(ShapeError, match="width"):
        float_device.launch(GATHER, 1, count=1)


def test_swapped_arguments_are_refused(float_device):
    """Same types, other order: the compiler's own names tell."""
    swapped = {name: TYPES[name] for name in ("width", "count", "indices", "rows", "result")}
    with pytest.raises(DeviceError, match="argument 0 is 'uint count', declared 'uint width'"):
        float_device._build(Kernel("gather.cl", "gather", **swapped), ())


def test_wrong_types_and_counts_are_refused(float_device):
    with pytest.raises(DeviceError, match="argument 2"):
        float_device._build(
            Kernel("gather.cl", "gather", **{**TYPES, "indices": ("real", "N")}), ())
    with pytest.raises(DeviceError, match="takes 5 arguments, 4 declared"):
        float_device._build(
            Kernel("gather.cl", "gather", **dict(list(TYPES.items())[:4])), ())


def test_a_kernel_that_does_not_build_names_its_file(float_device):
    with pytest.raises(DeviceError, match="sort.cl does not build"):
        float_device._build(Kernel("sort.cl", "sort_count", count="uint"), ())


def test_arrays_check_what_is_written_and_narrowed(float_device):
    rows = float_device.zeros((4, 3))
    rows.write(np.ones((2, 3)), first_row=2)
    assert np.array_equal(rows.download(), [[0] * 3] * 2 + [[1] * 3] * 2)
    assert rows.narrow(2).shape == (2, 3) and rows.last() == 1
    for wrong in (lambda: rows.write(np.ones((2, 3)), first_row=3), lambda: rows.narrow(5),
                  lambda: rows.write(np.ones((2, 2))), lambda: rows.reshaped(5, 3)):
        with pytest.raises(ShapeError):
            wrong()


def test_profiling_times_every_launch(float_device):
    device = Device(float_device.handle, profiling=True)
    values = device.upload(np.arange(1000, dtype=np.uint32))
    with device.profile() as times:
        exclusive_scan(device, values)
    assert set(times) == {"scan_reduce", "scan_apply"}
    assert all(len(t) == 1 and 0 < t[0] < 1 for t in times.values())
    with pytest.raises(DeviceError, match="without profiling"), float_device.profile():
        pass
