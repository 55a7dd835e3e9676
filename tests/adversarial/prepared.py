"""The small inputs that cases begin with: made once for a version of the code, then copied."""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STEPS = 12  # of the run
LINES = {  # name -> what makes it; `half` was stopped, so that it ends with 130
    "sy": "clsplat synth -o sy --blocks 1x1 --views 12 --size 96x64",
    "run": f"clsplat train sy -n {STEPS} --checkpoint-every 4 -q -o run",
    "half": f"clsplat train sy -n {STEPS} --checkpoint-every 4 -q --stop-at 6 -o half",
    "parted": "clsplat train sy --coarse -n 4 -q -o parted/coarse && "
              "clsplat partition parted --grid 2x1",
    "city": "clsplat city sy -n 8 --grid 2x1 -q -o city",
}

SCRIPTS = {  # what a case's line can call
    # as its console script, for `-m` would import modules of the current folder
    "clsplat": f'"{Path(sys.executable).with_name("clsplat")}"', "python": f'"{sys.executable}"',
    "dask": f'"{sys.executable}" -m dask',
    # root to whom the permissions of files apply as to others
    "unprivileged": "setpriv --bounding-set=-dac_override,-dac_read_search,-fowner"}


def environment(scratch: Path) -> dict[str, str]:
    """Of a command: `clsplat` on the path is this checkout's; temporary files go to `scratch`."""
    scripts = scratch / "bin"
    scripts.mkdir(parents=True, exist_ok=True)
    (scratch / "tmp").mkdir(exist_ok=True)
    for name, text in SCRIPTS.items():
        if not (scripts / name).exists():  # it may be running
            made = scripts / f"{name}-{threading.get_ident()}"
            made.write_text(f'#!/bin/sh\nexec {text} "$@"\n')
            made.chmod(0o755)
            made.rename(scripts / name)
    return {**os.environ, "PATH": f"{scripts}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT),
            "PYTHONDONTWRITEBYTECODE": "1", "TMPDIR": str(scratch / "tmp")}


def prepared() -> Path:
    """The folder that holds all of LINES, made if it is not there for this code."""
    digest = hashlib.sha256(repr(LINES).encode())
    for path in sorted([*ROOT.glob("clsplat/**/*.py"), *ROOT.glob("cl/**/*.[clh]*")]):
        if path.is_file():
            digest.update(path.read_bytes())
    name = f"clsplat-adversarial-{os.getuid()}-{digest.hexdigest()[:12]}"
    folder = Path(tempfile.gettempdir()) / name
    if not folder.is_dir():
        making = Path(tempfile.mkdtemp(prefix="clsplat-adversarial-"))
        making.chmod(0o755)
        for name, line in LINES.items():
            done = subprocess.run(["bash", "-c", line], cwd=making, text=True, check=False,
                                  capture_output=True, env=environment(making / ".scratch"))
            if done.returncode != (130 if name == "half" else 0):
                raise SystemExit(f"{name}: `{line}` ended with {done.returncode}\n{done.stderr}")
        shutil.rmtree(making / ".scratch")
        _point_elsewhere(making, making, folder)
        try:
            os.rename(making, folder)
        except OSError:  # another process was quicker
            shutil.rmtree(making)
    return folder


def provide(names, folder: Path) -> None:
    """Copy prepared inputs into a folder; whatever names its place there names the new one."""
    source = prepared()
    for name in names:
        shutil.copytree(source / name, folder / name, symlinks=True)
    _point_elsewhere(folder, source, folder)


def _point_elsewhere(folder, before, after):
    for path in folder.rglob("*"):
        if path.is_symlink():
            target = os.readlink(path)
            if target.startswith(str(before)):
                path.unlink()
                path.symlink_to(str(after) + target[len(str(before)):])
        elif path.name in ("options.json", "city.json", "block.json"):
            path.write_text(path.read_text().replace(str(before), str(after)))
