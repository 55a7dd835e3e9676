"""OpenCL runtimes from PyPI. Must be imported before pyopencl is.

The wheel `intel-opencl-rt` brings a fast CPU runtime, but its ICD file has the path of the machine
it was built on, and the loader reads only one folder, once: when platforms are first listed.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")
# pyopencl's own cache of binaries: see clsplat/device/programs.py
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")


@contextmanager
def intel_runtime() -> Iterator[None]:
    """A block in which the loader finds this Python environment's Intel CPU runtime, beside the
    system's; without effect where there is none, or where the user has chosen a folder."""
    homes = sys.prefix, sys.base_prefix, os.path.expanduser("~/.local")
    libraries = [Path(home) / "lib" / "libintelocl.so" for home in homes]
    library = next(filter(Path.exists, libraries), None)
    if library is None or "OCL_ICD_VENDORS" in os.environ:
        yield
        return
    with TemporaryDirectory(prefix="clsplat-icd-") as folder:
        for icd in SYSTEM_VENDORS.glob("*.icd"):
            Path(folder, icd.name).write_bytes(icd.read_bytes())
        Path(folder, "clsplat-intel-cpu.icd").write_text(f"{library}\n", encoding="utf-8")
        os.environ["OCL_ICD_VENDORS"] = folder
        try:
            yield
        finally:
            os.environ.pop("OCL_ICD_VENDORS", None)
