"""The source of programs, and a cache of compiled ones on disk for a runtime that has none.

Intel's CPU runtime compiles the kernels of a training in 3.3 s; reading them back takes 0.1 s.
PoCL, NVIDIA's driver, Mesa and Intel's GPU driver have caches of their own. pyopencl's cache is not
used: a process that was killed leaves its lock, and the next one waits a minute for it.
"""

import hashlib
import os
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import pyopencl as cl

from clsplat.constants import SHARED
from clsplat.device.kernel import Contract
from clsplat.errors import DeviceError

PLATFORMS = ("Intel(R) OpenCL",)
KEPT_DAYS = 60  # since its last use
INCLUDE = re.compile(r'^#include "(.+)"$')


def build(
    context: cl.Context, device: cl.Device, source: str, options: list[str], contracts: Sequence[Contract]
) -> Any:
    """Compile a program for one device, or read it back from the cache.

    A binary has no names of arguments, which are needed to check a kernel's declaration. So only a
    program that all declarations fit is stored, and read back for these only. One that cannot be
    read or stored is compiled as if there were no cache.

    Parameters
    ----------
    source : without #include, since a change of an included file would not be noticed.
    contracts : all declarations of kernels of this source.

    Returns
    -------
    A built Program of pyopencl.

    Raises
    ------
    cl.Error : the source does not compile.
    """
    file = _file_of(device, source, options, contracts)
    if file and (content := _read(file)):
        with suppress(cl.Error):
            return cl.Program(context, [device], [content]).build(options)
    program = cl.Program(context, source).build(options)
    if file and all(_fits(program, contract) for contract in contracts):
        _keep(file, program.get_info(cl.program_info.BINARIES)[0])
    return program


def _fits(program: cl.Program, contract: Contract) -> bool:
    """Whether a kernel is declared as the program has it, if it does: some builds lack some."""
    function = contract.kernel.function
    if function in program.kernel_names.split(";"):
        try:
            contract.check_built(cl.Kernel(program, function))
        except DeviceError:
            return False
    return True


def _file_of(device: cl.Device, source: str, options: list[str], contracts: Sequence[Contract]) -> Path | None:
    """The file of this program; None for a platform with its own cache, or a user without a home."""
    if device.platform.name not in PLATFORMS:
        return None
    words = (
        source,
        options,
        sorted(f"{each.kernel} {each.arguments}" for each in contracts),
        device.platform.version,
        device.name,
        device.version,
        device.driver_version,
    )
    try:
        return Path.home() / ".cache" / "clsplat" / "kernels" / _digest(repr(words).encode()).hex()
    except RuntimeError:  # a container's user who has no home
        return None


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


def _read(file: Path) -> bytes:
    """The binary in a file; none where it is missing or damaged, as runtimes crash on these."""
    with suppress(OSError):
        stored = file.read_bytes()
        if stored[:32] == _digest(stored[32:]):
            os.utime(file)
            return stored[32:]
    return b""


def _keep(file: Path, content: bytes) -> None:
    temporary = file.with_name(f"{file.name}-{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(_digest(content) + content)
        temporary.replace(file)
        for other in file.parent.iterdir():
            if time.time() - other.stat().st_mtime > KEPT_DAYS * 86400:
                other.unlink()
    except OSError:  # a full disk, or a home that may not be written
        with suppress(OSError):
            temporary.unlink()


@cache
def kernel_folder() -> Path:
    """The folder `cl`; DeviceError where the installation lacks it."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "cl", package.parent / "cl"):
        if (folder / "blend.cl").exists():
            return folder
    raise DeviceError(f"no OpenCL sources beside {package}: install clsplat again")


@cache
def kernel_source(name: str) -> str:
    """The text of a file of `cl` with the included files in place of the #include lines.

    Caches of compiled kernels, ours and those of drivers, compare this text, so they notice a
    change of an included file. #line directives let compilers name the files.
    """
    return "\n".join(_lines(name))


@cache
def words_of(name: str) -> frozenset[str]:
    """The words of a file of `cl` with its included files."""
    return frozenset(re.findall(r"\w+", kernel_source(name)))


def _lines(name: str) -> Iterator[str]:
    """Lines of the file "blend.cl", "item/blend.cl", "real.h" of include/, or an absolute path,
    beside which its own included files may lie."""
    folder = kernel_folder() / ("include" if name.endswith(".h") else "")
    shown = name.replace("\\", "/")  # a backslash of Windows would be an escape
    yield f'#line 1 "{shown}"'
    for number, line in enumerate((folder / name).read_text(encoding="utf-8").splitlines(), 1):
        if included := INCLUDE.match(line):
            beside = Path(name).parent / included[1]
            own = beside.is_absolute() and beside.exists()
            yield from _lines(str(beside) if own else included[1])
            yield f'#line {number + 1} "{shown}"'
        else:
            yield line


def define_options(pairs: Iterable[tuple[str, Any]]) -> list[str]:
    """Compiler options that define the numbers that host and kernels share, and `pairs` of names
    and values, which take precedence.

    A float's repr reads back as the same double, or as the nearest float.
    """
    return [
        f"-D{name}={value}{'u' * (isinstance(value, int) and value >= 2**31)}"
        for name, value in {**SHARED, **dict(pairs)}.items()
    ]
