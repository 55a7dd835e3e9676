"""Cities as they grow, and against one run; writes OUT/cities.md and OUT/cities.jsonl.

    python -m tools.studies.cities OUT [SCENE[:DOWNSCALE] ...]

Makes cities of --streets, at equal density of photos and points, and trains each in as many blocks
as it has streets (table area). Then it trains each SCENE and a made city of 3x3 streets, as one run
and as a city of 2x2 blocks, in turns (one-run), and with both methods and schedules (schedules).
Commands that have finished are not repeated; one that was stopped begins anew, as its time counts.
The machine should do nothing else:

    python -m tools.studies.cities out/cities ../shared/data/caliterra:2
"""

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.report.page import Table
from tools.studies.study import Scene, cell, flags_after, keep, keeps, markdown, outermost, refuse
from tools.synth.__main__ import synthesise

STEPS_A_STREET = 300  # of a made city, for each of its K x K streets; so many photos show it:
PHOTOS_A_STREET = 8
COMPARED = 3, 64, "320x240"  # the made city that is compared with one run: streets, photos, size
MIB = 2**20


def main(argv):
    """Train what is missing and write the tables."""
    words, flags = flags_after(argv)
    arguments = _parser().parse_args(words)
    if arguments.seeds < 1 or min(arguments.streets) < 1:
        raise InputError("--seeds and --streets: expect numbers of at least 1")
    work = Work(arguments.out, tuple(flags))
    arguments.out.mkdir(parents=True, exist_ok=True)
    possible = list(TABLES) if arguments.scenes or arguments.compared else ["area"]
    for name in arguments.tables or ():
        if name not in possible:
            raise InputError(f"--tables {name}: needs a SCENE; add that")
    tables = arguments.tables or possible
    scenes = [(scene.name, scene.path, scene.downscale) for scene in arguments.scenes]
    if arguments.compared and {"one-run", "schedules"} & set(tables):
        scenes.insert(0, ("made-city", made_city(work, *COMPARED), 1.0))
    command = f"python -m tools.studies.cities {shlex.join(argv)}"
    work.train("kernels", *growing(work, arguments.streets[0], arguments.size))  # builds them
    made = []
    for name in tables:
        made.append(TABLES[name](work, scenes, arguments))
        with replacing(arguments.out / "cities.md") as file:
            file.write(
                (
                    "\n\n".join(
                        ["# Cities", f"Made by `{command}` on {work.machine}; do not edit.", *map(markdown, made)]
                    )
                    + "\n"
                ).encode()
            )
        print(f"\n{made[-1].text()}\n", flush=True)
    keep(arguments.keep, made, command, work.machine)
    refuse(work.failed)


def _parser():
    made = argparse.ArgumentParser(
        description=__doc__,
        epilog="Flags of `clsplat train` and `clsplat city`, for all commands, may follow after --.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("out", type=Path, help="folder of scenes, runs and results")
    made.add_argument("scenes", nargs="*", type=Scene, metavar="SCENE[:DOWNSCALE]")
    made.add_argument(
        "--streets",
        type=int,
        nargs="+",
        default=[2, 4, 6],
        help="streets along each side of the cities that grow; default 2 4 6",
    )
    made.add_argument("--size", default="240x180", help="of their photos; default 240x180")
    made.add_argument("--seeds", type=int, default=3, help="of what is compared; default 3")
    made.add_argument(
        "--tables", nargs="+", choices=TABLES, help="those that are made; default: all for which scenes are named"
    )
    keeps(made)
    made.add_argument(
        "--no-compared", dest="compared", action="store_false", help="leave out the made city of 3x3 streets"
    )
    return made


class Work:
    """Runs commands of clsplat, and remembers their time in OUT/cities.jsonl.

    Attributes
    ----------
    out : the folder.
    flags : of each training.
    failed : the folders whose command failed.
    machine : the device and the commit of the last training, as text.
    """

    def __init__(self, out, flags):
        self.out, self.flags, self.failed, self.machine = out, flags, [], "-"
        self._file = out / "cities.jsonl"
        lines = self._file.read_text().splitlines() if self._file.exists() else []
        self._seconds = {(record["name"], *record["words"]): record["seconds"] for record in map(json.loads, lines)}

    def train(self, name, command, scene, *flags):
        """Train OUT/NAME by the command "train" or "city", unless it has been; the folder and the
        seconds of the whole command."""
        folder, words = self.out / name, (command, *map(str, (scene, *flags)), *self.flags)
        if (name, *words) not in self._seconds:
            shutil.rmtree(folder, ignore_errors=True)
            print(f"{name}: clsplat {shlex.join(words)}", flush=True)
            begin = time.perf_counter()
            code = clsplat(*words, "-o", folder, "-q")
            if code:
                self.failed.append(folder)
                return None, np.nan
            self._seconds[(name, *words)] = round(time.perf_counter() - begin, 2)
            with replacing(self._file) as file:
                file.writelines(
                    (json.dumps({"name": key[0], "words": key[1:], "seconds": seconds}) + "\n").encode()
                    for key, seconds in self._seconds.items()
                )
        facts = RunFolder(folder).read_options()
        self.machine = f"{facts.get('opencl_device')}, commit {facts.get('commit')}"
        return folder, self._seconds[(name, *words)]


def clsplat(*words):
    """The exit code of a command of clsplat."""
    return subprocess.run([sys.executable, "-m", "clsplat", *map(str, words)], check=False).returncode


def made_city(work, streets, photos, size):
    """The path of a city of streets x streets, which is made where it is missing."""
    scene = work.out / f"streets-{streets}x{streets}-{photos}-{size}"
    if not scene.exists():
        width, height = map(int, size.split("x"))
        synthesise(scene, (streets, streets), int(photos), (width, height))
    return scene


def scores_of(folder):
    """The last numbers of all events in a run's metrics, by name; empty for None."""
    found = {}
    for record in RunFolder(folder).records() if folder else ():
        found |= record
    return found


def growing(work, streets, size):
    """The command that trains a city of streets x streets in as many blocks."""
    return (
        "city",
        made_city(work, streets, PHOTOS_A_STREET * streets**2, size),
        "-n",
        STEPS_A_STREET * streets**2,
        "--grid",
        f"{streets}x{streets}",
        "--method",
        "blockgs",
        "--exchanges",
        "0",
    )


def area_table(work, scenes, arguments):
    """Time, memory and quality as the area grows: a column for each city."""
    head, columns, first = ["streets, and blocks"], [], None
    for streets in arguments.streets:
        grid = f"{streets}x{streets}"
        folder, seconds = work.train(f"area-{grid}", *growing(work, streets, arguments.size))
        first = first or (streets, seconds)
        blocks, inner = block_peaks(folder)
        scores = scores_of(folder)
        head.append(grid)
        columns.append(
            (
                cell(seconds, None, 1),
                cell(seconds / first[1], None, 2),
                cell((streets / first[0]) ** 2, None, 2),
                spread(blocks),
                spread(inner),
                cell(scores.get("gaussians"), None, 0),
                cell(scores.get("psnr_cc"), None, 2),
            )
        )
    names = (
        "whole command, s",
        "times the first",
        "times its area",
        "peak memory of a block, MiB: mean (least, most)",
        "the same of interior blocks, which have neighbours on all sides",
        "gaussians",
        "PSNR cc, dB",
    )
    rows = [(name, *column) for name, column in zip(names, zip(*columns))]
    return Table(
        "As a city grows",
        head,
        rows,
        range(1, len(head)),
        (f"Photos of {arguments.size}, {PHOTOS_A_STREET} a street, `--method blockgs`.",),
    )


def block_peaks(folder):
    """The peak device memory of the blocks of a city, MiB, and of those without an open side."""
    if folder is None:
        return [], []
    city = CityFolder(folder)
    peaks = [
        max(record.get("peak_bytes", 0) for record in RunFolder(block.run).records()) / MIB for block in city.blocks()
    ]
    closed = [bool(np.isfinite([region.low[:2], region.high[:2]]).all()) for region in city.partition().regions]
    return peaks, [peak for peak, inner in zip(peaks, closed) if inner]


def spread(values):
    """Mean, least and most of numbers as text."""
    return f"{np.mean(values):.1f} ({min(values):.1f}, {max(values):.1f})" if values else "-"


def one_run_table(work, scenes, arguments):
    """A city of 2x2 blocks against one run of the same scene: a row for each scene."""
    rows = []
    for name, scene, downscale in scenes:
        found = []
        for seed in range(arguments.seeds):
            same = "-r", f"{downscale:g}", "--seed", str(seed)
            one, one_seconds = work.train(f"one-{name}.{seed}", "train", scene, *same, "--eval-every", "end")
            city, seconds = work.train(
                f"city-{name}.{seed}", "city", scene, *same, "--grid", "2x2", *(("--against", str(one)) if one else ())
            )
            scores, own = scores_of(city), scores_of(one)
            found.append(
                (
                    one_seconds,
                    seconds,
                    *(
                        values.get(key, np.nan)
                        for values, key in (
                            (own, "psnr_cc"),
                            (scores, "psnr_cc"),
                            (scores, "seam_db"),
                            (scores, "worst_seam_db"),
                        )
                    ),
                )
            )
        one_seconds, seconds, single, merged, seam, worst = np.array(found, float).T
        rows.append(
            (
                name,
                cell(np.median(one_seconds), None, 1),
                cell(np.median(seconds), None, 1),
                cell(np.median(seconds / one_seconds), None, 2),
                *(cell(values.mean(), values.std(), 2) for values in (single, merged)),
                cell((merged - single).mean(), None, 2, "+"),
                *(cell(values.mean(), values.std(), 2) for values in (seam, worst)),
            )
        )
    return Table(
        "Merged against one run",
        (
            "scene",
            "one run, s",
            "city, s",
            "ratio",
            "one run, cc",
            "city, cc",
            "difference",
            "seams, mean",
            "seams, worst",
        ),
        rows,
        range(1, 9),
        (
            f"{arguments.seeds} seeds, mean and standard deviation; seconds of the whole command, "
            "medians, of which the first may build kernels; cc: PSNR with colours corrected, dB; "
            "seams: what the city lacks beside borders against one run with the same seed, dB.",
        ),
    )


def schedule_table(work, scenes, arguments):
    """SIG against the constant schedule, on both methods: a row for each scene and method."""
    rows = []
    for name, scene, downscale in scenes:
        for method in ("citygs", "blockgs"):
            results = []
            for schedule in ("sig", "constant"):
                folder, seconds = work.train(
                    f"{schedule}-{method}-{name}",
                    "city",
                    scene,
                    "-r",
                    f"{downscale:g}",
                    "--grid",
                    "2x2",
                    "--method",
                    method,
                    "--schedule",
                    schedule,
                )
                results.append((seconds, scores_of(folder).get("psnr_cc", np.nan)))
            (seconds, cc), (constant_seconds, constant_cc) = results
            rows.append(
                (
                    name,
                    method,
                    cell(seconds, None, 1),
                    cell(constant_seconds, None, 1),
                    cell(constant_seconds / seconds, None, 2),
                    cell(cc, None, 2),
                    cell(constant_cc, None, 2),
                )
            )
    return Table(
        "Sig on CityGS and on BlockGS",
        ("scene", "method", "sig, s", "constant, s", "times as fast", "sig, cc", "constant, cc"),
        rows,
        range(2, 7),
    )


TABLES = {"area": area_table, "one-run": one_run_table, "schedules": schedule_table}


if __name__ == "__main__":
    outermost(main)
