"""Contracts of kernels: what does not fit is refused, and the message names it."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from clsplat.device import Device, Forms, Kernel, each, groups, items
from clsplat.device import device as device_module
from clsplat.errors import DeviceError, ShapeError
from clsplat.primitives.compact import compact, new_counts
from clsplat.primitives.gather import GATHER

TYPES = GATHER.forms.item.arguments


@pytest.fixture
def call(float_device):
    """Launches `gather` with good arguments, some replaced."""
    good = {
        "count": 4,
        "width": 3,
        "indices": float_device.zeros(4, np.uint32),
        "rows": float_device.zeros((9, 3)),
        "result": float_device.zeros((4, 3)),
    }

    def launch(**changes):
        float_device.launch(GATHER, **{**good, **changes})

    return launch


@pytest.mark.parametrize(
    "name, shape, dtype",
    [
        ("rows", (9, 4), None),
        ("rows", (9,), None),
        ("indices", (5,), np.uint32),
        ("indices", (4,), np.int32),
        ("result", (4, 3), np.uint32),
        ("rows", (9, 3), np.float64),
    ],
)
def test_a_wrong_array_is_named(call, float_device, name, shape, dtype):
    # where lengths disagree, it is the later of the two arguments that does not fit
    blamed = "result" if shape in ((9, 4), (5,)) else name
    with pytest.raises(ShapeError, match=f"gather in gather.cl: '{blamed}'"):
        call(**{name: float_device.zeros(shape, dtype)})


def test_unknown_and_missing_arguments_are_named(call, float_device):
    with pytest.raises(ShapeError, match="colour"):
        call(colour=1)
    with pytest.raises(ShapeError, match="width"):
        float_device.launch(GATHER, count=1)


def test_swapped_arguments_are_refused(float_device):
    """Same types, other order: the compiler's own names tell."""
    swapped = {name: TYPES[name] for name in ("width", "count", "indices", "rows", "result")}
    with pytest.raises(DeviceError, match="argument 0 is 'uint count', declared 'uint width'"):
        float_device._build(Kernel("gather.cl", "gather", each("count"), **swapped), ())


def test_wrong_types_and_counts_are_refused(float_device):
    with pytest.raises(DeviceError, match="argument 2"):
        float_device._build(Kernel("gather.cl", "gather", each("count"), **{**TYPES, "indices": ("real", "N")}), ())
    with pytest.raises(DeviceError, match="it has 5 arguments, 4 are declared"):
        float_device._build(Kernel("gather.cl", "gather", each("count"), **dict(list(TYPES.items())[:4])), ())


def test_a_kernel_that_does_not_build_names_its_file(float_device):
    with pytest.raises(DeviceError, match="sort.cl does not build"):
        float_device._build(Kernel("sort.cl", "sort_count", each("count"), count="uint"), ())


def test_what_threads_compile_is_launched_or_refused_at_its_launch(float_device, monkeypatch):
    """What does not build only there, and what was cancelled is compiled."""
    gather, sort = (
        Kernel("gather.cl", "gather", each("count"), **TYPES),
        Kernel("sort.cl", "sort_count", each("count"), count="uint"),
    )
    device = Device(float_device.handle, form=float_device.form)
    with ThreadPoolExecutor(1) as threads:
        device.build_ahead([(gather, ()), (gather, ()), (sort, ())], threads)
        cancelled = Device(float_device.handle, form=float_device.form)
        threads.submit(time.sleep, 0.1)
        cancelled.build_ahead([(gather, ())], threads)
        threads.shutdown(cancel_futures=True)
    with pytest.raises(DeviceError, match="sort.cl does not build"):
        device._build(sort, ())
    cancelled._build(gather, ())
    monkeypatch.setattr(device_module, "build", pytest.fail)  # nothing is compiled any more
    device._build(gather, ())
    assert not device._ahead and not cancelled._ahead


def test_what_a_source_does_not_name_compiles_nothing(float_device):
    kernel = Kernel("gather.cl", "gather", each("count"), **TYPES)
    float_device._build(kernel, ())
    before = len(float_device._programs)
    float_device._build(kernel, (("NAMED_NOWHERE", 1),))
    assert len(float_device._programs) == before
    float_device._build(kernel, (("restrict", ""),))
    assert len(float_device._programs) == before + 1


@pytest.mark.parametrize(
    "launch, expected",
    [
        (items("count"), (7, 1)),
        (items("count/3 2"), (6, 1)),
        (items("N/TILE"), (1, 1)),
        (items("count", "5"), (10, 5)),
        (groups("count", "SCAN_GROUP"), (7 * 64, 64)),
        (groups("N 2", "TILE TILE"), (2 * 12 * 256, 256)),
        (groups("PER_ITEM", "2"), (16, 2)),
        (items("0"), (0, 1)),
        (each("count N"), {"item": (8, 1), "group": (96, 32)}),
    ],
)
def test_launches_have_the_declared_size(float_device, monkeypatch, launch, expected):
    device = float_device
    for name, size in {"scan_group": 64, "group_size": 32, "compute_units": 2, "tile": 16}.items():
        monkeypatch.setattr(device, name, size)
    kernel = Kernel("none.cl", "none", launch, count="uint", rows=("real", "N"))
    bound = kernel.bind(device, {"count": 7, "rows": device.zeros(12)})
    if isinstance(expected, dict):
        expected = expected[device.form]
    assert bound[1:] == expected


def test_each_form_has_its_own_launch_and_arguments(float_device):
    kernel = Kernel(
        "none.cl",
        "none",
        Forms(item=items("count", more=("real", "N")), group=groups("size", "2", size="uint")),
        count="uint",
    )
    rows = float_device.zeros(3)
    bound = kernel.bind(float_device, {"count": 5, "more": rows, "size": 3})
    assert bound == Forms(item=([5, rows.buffer], 5, 1), group=([5, 3], 6, 2)).of(float_device)
    with pytest.raises(ShapeError, match="size"):  # whatever the form: a call is right in both
        kernel.bind(float_device, {"count": 5, "more": rows})


@pytest.mark.parametrize("size", ["rows", "chunk", "N/width", "COUNT"])
def test_a_launch_by_what_is_no_argument_is_refused(size):
    with pytest.raises(DeviceError, match="not an argument"):
        Kernel("none.cl", "none", items(size), count="uint", rows=("real", "N"))


def test_arrays_check_what_is_written_and_narrowed(float_device):
    rows = float_device.zeros((4, 3))
    rows.write(np.ones((2, 3)), first_row=2)
    assert np.array_equal(rows.download(), [[0] * 3] * 2 + [[1] * 3] * 2)
    assert rows.narrow(2).shape == (2, 3)
    for wrong in (
        lambda: rows.write(np.ones((2, 3)), first_row=3),
        lambda: rows.narrow(5),
        lambda: rows.write(np.ones((2, 2))),
        lambda: rows.reshaped(5, 3),
    ):
        with pytest.raises(ShapeError):
            wrong()


def test_profiling_times_every_launch(float_device):
    device = Device(float_device.handle, profiling=True)
    flags = device.upload(np.arange(1000, dtype=np.uint32) % 2)
    with device.profile() as times:
        compact(device, flags, new_counts(device))
    assert set(times) == {"count_flags", "compact"}
    assert all(len(t) == 1 and 0 < t[0] < 1 for t in times.values())
    with pytest.raises(DeviceError, match="without profiling"), float_device.profile():
        pass
