"""Finds the OpenCL sources: inside the package once installed, else beside it in a checkout."""

from functools import cache
from pathlib import Path

from clsplat.errors import DeviceError


@cache
def kernel_folder():
    """The folder `cl`; raises DeviceError where the installation lacks it."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "cl", package.parent / "cl"):
        if (folder / "blend.cl").exists():
            return folder
    raise DeviceError(f"no OpenCL sources beside {package}: install clsplat again")


@cache
def kernel_source(name):
    return (kernel_folder() / name).read_text(encoding="utf-8")
