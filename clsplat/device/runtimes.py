"""Makes OpenCL runtimes from PyPI visible. Must run before pyopencl is first imported.

The wheel `intel-opencl-rt` brings a fast CPU runtime, but its ICD file has the path of the
machine it was built on, and the loader reads only one folder. So a private folder is made with the
system's ICD files and one with the true path; a folder that the user has chosen is not changed.
"""

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")


def intel_library() -> Path | None:
    """Path of the Intel CPU runtime's library in this Python environment, or None."""
    for prefix in (sys.prefix, sys.base_prefix, os.path.expanduser("~/.local")):
        library = Path(prefix) / "lib" / "libintelocl.so"
        if library.exists():
            return library
    return None


def register() -> None:
    """Set OCL_ICD_VENDORS to a folder with every runtime, once in a process."""
    library = intel_library()
    if library is None or "OCL_ICD_VENDORS" in os.environ:
        return
    files = {icd.name: icd.read_text("utf-8") for icd in sorted(SYSTEM_VENDORS.glob("*.icd"))}
    files["clsplat-intel-cpu.icd"] = f"{library}\n"
    name = hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()[:16]
    os.environ["OCL_ICD_VENDORS"] = str(_folder_of(files, name))


def _folder_of(files: dict[str, str], name: str) -> Path:
    """A folder with these files, by their names: the same in every process of this user, so that a
    killed one leaves nothing behind; a temporary one where the user has no cache."""
    try:
        return _written(Path.home() / ".cache" / "clsplat" / "vendors" / name, files)
    except (OSError, RuntimeError):  # not writable; or a container's user who has no home
        folder = Path(tempfile.mkdtemp(prefix="clsplat-icd-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return _written(folder, files)


def _written(folder: Path, files: dict[str, str]) -> Path:
    """The folder, with what it lacks; other processes may do the same."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        if not (folder / name).is_file():
            temporary = folder / f"{name}-{os.getpid()}"
            temporary.write_text(text, encoding="utf-8")
            temporary.replace(folder / name)
    return folder


register()
# pyopencl's own cache of binaries: see clsplat/device/programs.py
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
