"""python -m tests.adversarial.disk_full: a disk that runs full after every so many bytes.

Each command writes to a small tmpfs that is filled beforehand but for a number of bytes, which
grows by a step until the command works. Before that it must end with exit code 2 and one line that
names the file and the cure, and leave no half file; and once there is space, the same command, or
what goes on from there, must end in the same bytes as on a disk that was never full.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from tests.adversarial.campaign import faults_of, faults_of_files, patience, run_line
from tests.adversarial.prepared import environment, provide
from tests.adversarial.sweep import arguments_of, finish
from tests.adversarial.whole import listing

KIB = 1024
DISK = 32 * 1024 * KIB
MOST = 60  # steps of one command
CURE = re.compile(r"error: .*(free|space|disk|full)", re.IGNORECASE)


@dataclass(frozen=True)
class Target:
    """line: what is tried; again: what goes on once there is space (the same where empty);
    needs: what lies on the disk that runs full; step: bytes; begins: with so many bytes free;
    proof: files whose bytes show that nothing was lost."""

    name: str
    line: str
    proof: tuple[str, ...]
    needs: tuple[str, ...] = ()
    again: str = ""
    step: int = 64 * KIB
    begins: int = 0


TRAIN = "clsplat train small -n 8 --checkpoint-every 3 -q -o disk/out"
TARGETS = (
    Target("train", TRAIN, ("out/point_cloud.ply",),
           again=f"clsplat train small -o disk/out --resume -q || {TRAIN} --overwrite"),
    Target("report", "clsplat train small -o disk/half --resume -q", ("half/point_cloud.ply",),
           ("half",)),
    Target("eval", "clsplat eval disk/run", ("run/renders/test/000.jpg.png",), ("run",),
           step=4 * KIB),
    Target("render", "clsplat render disk/run -o disk/out", ("out/000.jpg.png", "out/005.jpg.png"),
           ("run",), step=8 * KIB),
    Target("export", "clsplat export disk/run -o disk/out.ply", ("out.ply",), ("run",),
           step=16 * KIB),
    Target("compare", "clsplat compare disk/run -o disk/out", ("out/compare.json",), ("run",)),
    Target("synth", "clsplat synth -o disk/out --blocks 1x1 --views 6 --size 64x48",
           ("out/images/000.jpg", "out/sparse/0/points3D.bin"), step=16 * KIB,
           again="clsplat synth -o disk/out --blocks 1x1 --views 6 --size 64x48 --overwrite"),
    Target("pack", "clsplat pack small -o disk/out.npz", ("out.npz",), step=32 * KIB),
    Target("merge", "clsplat merge disk/city", ("city/point_cloud.ply",), ("city",)),
    Target("city", "clsplat city small -n 4 --grid 2x1 --least-views 1 -q -o disk/out",
           ("out/point_cloud.ply",)),
)
LINES = {  # of small inputs, so that there are few steps
    "small": "clsplat synth -o small --blocks 1x1 --views 8 --size 40x30",
    "run": "clsplat train small -n 8 --checkpoint-every 3 -q -o run",
    "half": "clsplat train small -n 8 --checkpoint-every 3 -q --stop-at 4 -o half",
    "city": "clsplat city small -n 4 --grid 2x1 --least-views 1 -q -o city"}


def _thin(folder):
    """Keep one point in four of a COLMAP model."""
    model = pycolmap.Reconstruction(str(folder))
    for number in sorted(model.point3D_ids()):
        if number % 4:
            model.delete_point3D(number)
    model.write(str(folder))


def can_mount() -> str | None:
    """Why this machine cannot mount a tmpfs, or None."""
    folder = tempfile.mkdtemp()
    try:
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder],
                              check=False, capture_output=True, text=True)
        if done.returncode:
            return f"no tmpfs can be mounted here: {done.stderr.strip()}"
        subprocess.run(["umount", folder], check=True)
    except OSError as error:
        return f"no tmpfs can be mounted here: {error}"
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return None


class Workplace:
    """A folder with the inputs of targets, and in it `disk`, mounted anew for each try."""

    def __init__(self, targets):
        self.needs = {"small", *(name for target in targets for name in target.needs)}

    def __enter__(self):
        self.base = Path(tempfile.mkdtemp(prefix="clsplat-full-"))
        self.folder, self.disk = self.base / "case", self.base / "case" / "disk"
        self.disk.mkdir(parents=True)
        environment(self.base / "scratch")
        provide((), self.folder)
        for name, line in LINES.items():
            if name not in self.needs:
                continue
            result = self.run(line)
            if result.code not in (0, 130):
                raise SystemExit(f"{line}: {result.output}")
            if name == "small":
                _thin(self.folder / "small/sparse/0")
        return self

    def __exit__(self, *_):
        subprocess.run(["umount", "-l", str(self.disk)], check=False, capture_output=True)
        shutil.rmtree(self.base, ignore_errors=True)

    def run(self, line):
        return run_line(line, self.folder, self.base / "scratch", 120 * patience())

    def fresh(self, target, free=None):
        """An emptied disk with what the target needs, and `free` bytes beside that."""
        subprocess.run(["umount", "-l", str(self.disk)], check=False, capture_output=True)
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(self.disk)],
                       check=True)
        for name in target.needs:
            shutil.copytree(self.folder / name, self.disk / name, symlinks=True)
        if free is not None:
            self.fill(free)

    def fill(self, free):
        usage = shutil.disk_usage(self.disk)
        with open(self.disk / "filler", "wb") as file:
            file.write(bytes(max(0, usage.free - free)))

    def proof(self, target):
        """name -> bytes, or None where the file is missing."""
        return {name: (self.disk / name).read_bytes() if (self.disk / name).is_file() else None
                for name in target.proof}


def sweep(place, target):
    """A record for each number of free bytes, until the command works."""
    place.fresh(target)
    result = place.run(target.line)
    expected = place.proof(target)
    if result.code or None in expected.values():
        yield {"case": target.name, "free": "all", "exits": [result.code], "error": "",
               "faults": ["does not work with all the space"], "output": result.output[-900:]}
        return
    for number in range(MOST):
        free = target.begins + number * target.step
        place.fresh(target, free)
        before = listing(place.disk)
        result = place.run(target.line)
        faults = faults_of(result, (0, 2))
        faults += faults_of_files(place.disk, before, (
            "out", "out.ply", "out.npz", "out.geometry.json", *target.needs))
        if result.code == 2 and not CURE.search(result.output):
            faults.append("the error names no cure for a full disk")
        worked = result.code == 0
        if worked and place.proof(target) != expected:
            faults.append("says that it worked, but its files are others")
        exits = [result.code]
        if not worked:
            (place.disk / "filler").unlink(missing_ok=True)
            after = place.run(target.again or target.line)
            exits.append(after.code)
            faults += [f"with space again: {each}" for each in faults_of(after, (0,))
                       if "||" not in target.again or after.code]
            if place.proof(target) != expected:
                faults.append("with space again: other bytes than on a disk that was never full")
        yield {"case": target.name, "free": f"{free // KIB} KiB", "exits": exits,
               "error": (result.errors or [""])[0][:110], "faults": faults,
               "output": result.output[-900:]}
        if worked and not faults:
            return


def main(words=None):
    """Sweep; the number of tries with faults."""
    arguments = arguments_of("disk_full", __doc__, words,
                             coarser={"type": int, "default": 1, "help": "times the step"})
    reason = can_mount()
    if reason:
        print(f"skipped: {reason}")
        return 0
    chosen = [target for target in TARGETS if not arguments.name or target.name in arguments.name]
    with Workplace(chosen) as place:
        records = (record for target in chosen for record in sweep(place, Target(
            **{**vars(target), "step": target.step * arguments.coarser})))
        return finish(records, arguments, ("case", "free", "exits", "error"))


if __name__ == "__main__":
    sys.exit(1 if main() else 0)
