"""Tests of what a device can do, by building and running two-line kernels.

Every device needs OpenCL C 1.2, 32-bit integer atomics, 32 KiB of local memory and work-groups of
at least 64. A feature that a driver lists may not work, so only what has run counts.
"""

import warnings
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

_KERNEL = """
#ifdef cl_khr_fp64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif
__kernel void probe(__global float *x)
{
    const float lane = get_local_id(0);
    %s;
}"""
_LANE = np.arange(32, dtype=np.float32)
_PLAIN = "x[get_local_id(0)] = exp(1.0f) + lane", np.e + _LANE
_FEATURES = {  # preprocessor name -> what a kernel does, and its result
    "HAVE_DOUBLE": ("x[get_local_id(0)] = (float)((double)lane + 1e-12 > (double)lane)", np.ones(32)),
    "HAVE_NATIVE_EXP": ("x[get_local_id(0)] = native_exp2(-0.26f * lane)", np.exp2(-0.26 * _LANE)),
    "HAVE_NATIVE_DIVIDE": (
        "x[get_local_id(0)] = native_divide(lane - 7.3f, 0.03f * lane + 0.01f)",
        (_LANE - 7.3) / (0.03 * _LANE + 0.01),
    ),
    "HAVE_PREFETCH": (
        "__builtin_prefetch((const void *)(size_t)(x + get_local_id(0))); x[get_local_id(0)] = lane",
        _LANE,
    ),
}


def _built(context: cl.Context, work: str) -> cl.Kernel:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cl.CompilerWarning)
        return cl.Kernel(cl.Program(context, _KERNEL % work).build(), "probe")


def _works(context: cl.Context, handle: cl.Device, work: str, expected: NDArray[Any]) -> bool:
    """Whether a kernel with one group of 32 builds and writes what is expected."""
    queue = cl.CommandQueue(context, handle)
    result = np.full(32, -1, np.float32)
    buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, result.nbytes)
    _built(context, work)(queue, (32,), (32,), buffer)
    cl.enqueue_copy(queue, result, buffer)
    return bool(np.allclose(result, expected, rtol=2e-6))


def probe_working(handle: cl.Device) -> str:
    """Why the device does not work, or "" if a two-line kernel gave the right results."""
    try:
        works = _works(cl.Context([handle]), handle, *_PLAIN)
    except cl.Error as error:
        text = " ".join(str(error).split())
        return f"a two-line kernel fails: {text[:160]}"
    if not works:
        return "a two-line kernel gives wrong results"
    if handle.local_mem_size < 32 << 10 or handle.max_work_group_size < 64:
        return "it has less than 32 KiB of local memory or work-groups of less than 64"
    return ""


def probe_wave(context: cl.Context, handle: cl.Device) -> int:
    """How many lanes run in step, 32 or 64: what the compiler prefers work-groups to be a multiple
    of; 32 on NVIDIA, 64 or 32 on AMD, and 32 for all that are no GPUs, where it hardly matters.
    """
    if not handle.type & cl.device_type.GPU:
        return 32
    multiple = _built(context, _PLAIN[0]).get_work_group_info(
        cl.kernel_work_group_info.PREFERRED_WORK_GROUP_SIZE_MULTIPLE, handle
    )
    return 64 if multiple == 64 else 32


def may_prefetch(handle: cl.Device) -> bool:
    """Whether clang's prefetch may be tried: only a CPU's kernels use it, and Mesa's compiler ends
    the process that tries it."""
    return bool(handle.type & cl.device_type.CPU) and any(
        name in handle.platform.name for name in ("Intel", "Portable Computing")
    )


def probe_capabilities(context: cl.Context, handle: cl.Device) -> dict[str, bool]:
    """The preprocessor names of optional features, and whether each one works."""
    works = {}
    for name, feature in _FEATURES.items():
        try:
            works[name] = (name != "HAVE_PREFETCH" or may_prefetch(handle)) and _works(context, handle, *feature)
        except cl.Error:
            works[name] = False
    return works
