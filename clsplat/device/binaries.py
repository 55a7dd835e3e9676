"""Compiled kernels kept between processes, for a runtime that compiles anew in each.

Intel's CPU runtime takes 3.3 s for the kernels of a training, each time; read back they take 0.1 s.
PoCL, NVIDIA's driver, Mesa and Intel's GPU driver keep caches of their own. pyopencl's cache is not
used: a process that was killed leaves its lock, and the next one waits a minute for it.
"""

import hashlib
import json
import os
import time
from contextlib import suppress
from pathlib import Path

import pyopencl as cl

from clsplat.errors import DeviceError

PLATFORMS = ("Intel(R) OpenCL",)
KEPT_DAYS = 60  # after its last use


def build(context, device, source, options, kernel, others=()):
    """(program, checked) of `source` for one device: text without #include, or a change of what it
    includes would not be noticed. pyopencl's errors where it does not build.

    A binary has no names of arguments, by which a kernel's declaration is checked. So it is kept
    with the declarations that fitted, of `kernel` and `others`, and read back for these only:
    checked is the set of their signatures, or None for a program whose arguments have names. What
    cannot be read back, or not be kept, is compiled as if there were no cache.
    """
    file = _file_of(device, source, options)
    checked, content = (file and _read(file)) or (frozenset(), b"")
    if kernel.signature in checked:
        with suppress(cl.Error):
            return cl.Program(context, [device], [content]).build(options), checked
    program = cl.Program(context, source).build(options)
    if file:
        fitting = {each.signature for each in (kernel, *others) if _fits(program, each)}
        _keep(file, sorted(fitting), program.get_info(cl.program_info.BINARIES)[0])
    return program, None


def _fits(program, kernel):
    """Whether the program has such a kernel; the other form's has the same name at most."""
    if kernel.function not in program.kernel_names.split(";"):
        return False
    with suppress(DeviceError):
        kernel.check_built(cl.Kernel(program, kernel.function))
        return True
    return False


def _file_of(device, source, options):
    """Where this program is kept; None for a platform without need, or a user without a home."""
    if device.platform.name not in PLATFORMS:
        return None
    words = (source, options, device.platform.version, device.name, device.version,
             device.driver_version)
    try:
        return Path.home() / ".cache" / "clsplat" / "kernels" / _digest(repr(words).encode()).hex()
    except RuntimeError:  # a container's user who has no home
        return None


def _digest(content):
    return hashlib.sha256(content).digest()


def _read(file):
    """(signatures, binary) of a file; None where there is none, or it is not as it was written:
    runtimes crash on damaged ones."""
    try:
        digest, rest = (whole := file.read_bytes())[:32], whole[32:]
        if digest != _digest(rest):
            return None
        os.utime(file)
    except OSError:
        return None
    head, _, content = rest.partition(b"\n")
    return frozenset(json.loads(head)), content


def _keep(file, signatures, content):
    rest = json.dumps(signatures).encode() + b"\n" + content
    made = file.with_name(f"{file.name}-{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        made.write_bytes(_digest(rest) + rest)
        made.replace(file)
        for other in file.parent.iterdir():
            if time.time() - other.stat().st_mtime > KEPT_DAYS * 86400:
                other.unlink()
    except OSError:  # a full disk, or a home that may not be written
        with suppress(OSError):
            made.unlink()
