"""Runtimes that would end the process are not asked for what they cannot do."""

from types import SimpleNamespace

import pyopencl as cl
import pytest

from clsplat.device.capabilities import may_prefetch


@pytest.mark.parametrize(
    "platform, kind, expected",
    [
        ("rusticl", "CPU", False),
        ("Clover", "CPU", False),
        ("Oclgrind", "CPU", False),
        ("Intel(R) OpenCL", "CPU", True),
        ("Portable Computing Language", "CPU", True),
        ("Portable Computing Language", "GPU", False),
        ("NVIDIA CUDA", "GPU", False),
    ],
)
def test_only_known_runtimes_are_asked_to_prefetch(platform, kind, expected):
    handle = SimpleNamespace(type=getattr(cl.device_type, kind), platform=SimpleNamespace(name=platform))
    assert may_prefetch(handle) is expected
