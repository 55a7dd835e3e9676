"""Compiled kernels kept between processes, for a runtime that compiles anew in each.

Intel's CPU runtime takes 3.3 s for the kernels of a training, each time; read back they take 0.1 s.
PoCL, NVIDIA's driver, Mesa and Intel's GPU driver keep caches of their own. pyopencl's cache is not
used: a process that was killed leaves its lock, and the next one waits a minute for it.
"""

import hashlib
import os
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

import pyopencl as cl

from clsplat.device.source import kernel_folder
from clsplat.errors import DeviceError

PLATFORMS = ("Intel(R) OpenCL",)
KEPT_DAYS = 60  # after its last use


def build(context, device, source, options, kernels):
    """A built program of `source` (text) for one device; pyopencl's errors where it does not build.

    kernels: the `Kernel`s declared of it. A binary has no names of arguments, so one is
    kept only where they fit, and read back for the same declarations only. What cannot be read
    back, or not be kept, is compiled as if there were no cache.
    """
    file = _file_of(device, source, options, kernels)
    content = _read(file) if file else None
    if content is not None:
        with suppress(cl.Error):
            return cl.Program(context, [device], [content]).build(options)
    program = cl.Program(context, source).build(options)
    if file and all(_is_declared(program, name, kernels) for name in
                    program.kernel_names.split(";")):
        _keep(file, program.get_info(cl.program_info.BINARIES)[0])
    return program


def _is_declared(program, name, kernels):
    """Whether a declaration fits: two forms of a kernel share its name, and not their arguments."""
    for kernel in (each for each in kernels if each.function == name):
        with suppress(DeviceError):
            kernel.check_built(cl.Kernel(program, name))
            return True
    return False


def _file_of(device, source, options, kernels):
    """Where this program is kept; None for a platform without need, or a user without a home."""
    if device.platform.name not in PLATFORMS:
        return None
    declared = sorted((kernel.function, *kernel.arguments.items()) for kernel in kernels)
    words = (source, _headers(), options, declared, device.platform.version, device.name,
             device.version, device.driver_version)
    try:
        return Path.home() / ".cache" / "clsplat" / "kernels" / _digest(repr(words).encode()).hex()
    except RuntimeError:  # a container's user who has no home
        return None


@cache
def _headers():
    return [file.read_text("utf-8") for file in sorted((kernel_folder() / "include").glob("*.h"))]


def _digest(content):
    return hashlib.sha256(content).digest()


def _read(file):
    """The binary of a file; None where there is none, or it is not as it was written: runtimes
    crash on damaged ones."""
    try:
        digest, content = (whole := file.read_bytes())[:32], whole[32:]
        if digest != _digest(content):
            return None
        os.utime(file)
    except OSError:
        return None
    return content


def _keep(file, content):
    made = file.with_name(f"{file.name}-{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        made.write_bytes(_digest(content) + content)
        made.replace(file)
        for other in file.parent.iterdir():
            if time.time() - other.stat().st_mtime > KEPT_DAYS * 86400:
                other.unlink()
    except OSError:  # a full disk, or a home that may not be written
        with suppress(OSError):
            made.unlink()
