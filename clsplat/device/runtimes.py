"""Makes OpenCL runtimes from PyPI visible. Must run before pyopencl is first imported.

The wheel `intel-opencl-rt` brings a fast CPU runtime, but its ICD file carries the path of the
machine it was built on, and the loader looks only in one folder. So a private folder is made that
holds the system's ICD files and one with the true path; a folder chosen by the user is left alone.
"""

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")


def intel_library():
    """Path of the Intel CPU runtime's library in this Python environment, or None."""
    for prefix in (sys.prefix, sys.base_prefix, os.path.expanduser("~/.local")):
        library = Path(prefix) / "lib" / "libintelocl.so"
        if library.exists():
            return library
    return None


def register():
    """Point OCL_ICD_VENDORS at a folder with every runtime, once a process."""
    library = intel_library()
    if library is None or "OCL_ICD_VENDORS" in os.environ:
        return
    folder = Path(tempfile.mkdtemp(prefix="clsplat-icd-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for icd in SYSTEM_VENDORS.glob("*.icd"):
        shutil.copy(icd, folder)
    (folder / "clsplat-intel-cpu.icd").write_text(f"{library}\n", encoding="utf-8")
    os.environ["OCL_ICD_VENDORS"] = str(folder)


register()
# pyopencl's own binary cache makes PoCL compile everything twice (inducer/pyopencl#731)
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
