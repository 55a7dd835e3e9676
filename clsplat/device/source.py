"""Finds the OpenCL sources: inside the package once installed, else beside it in a checkout."""

import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from clsplat.constants import NO_ROW, SHARED
from clsplat.errors import DeviceError

INCLUDE = re.compile(r'^#include "(.+)"$')


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
    """Lines of the file "blend.cl", "item/blend.cl", "real.h" of include/, or an absolute path."""
    folder = kernel_folder() / ("include" if name.endswith(".h") else "")
    shown = name.replace("\\", "/")  # a backslash of Windows would be an escape
    yield f'#line 1 "{shown}"'
    for number, line in enumerate((folder / name).read_text(encoding="utf-8").splitlines(), 1):
        if included := INCLUDE.match(line):
            yield from _lines(included[1])
            yield f'#line {number + 1} "{shown}"'
        else:
            yield line


def define_options(pairs: Iterable[tuple[str, Any]]) -> list[str]:
    """Compiler options that define the numbers that host and kernels share, and `pairs` of names
    and values, which take precedence.

    A float's repr reads back as the same double, or as the nearest float.
    """
    return [f"-D{name}={value}{'u' * (value == NO_ROW)}"
            for name, value in {**SHARED, **dict(pairs)}.items()]
