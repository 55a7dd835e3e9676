"""What each mechanism of a city gives: cities with one of them off at a time, as JSON lines.

    python -m tools.studies.city_ablation OUT SCENE[:DOWNSCALE] ... [-- FLAGS of clsplat city]

Each is trained with and without the joint training, first
with all mechanisms as they are by default, then with one of them off, or on where the default
leaves it off. A line is printed for each city, and kept in OUT/city_ablation.jsonl; cities that are
there are not trained again. The machine should do nothing else, as their time counts.

    mechanism         the switch
    dense             filled: blocks begin without dense points in gaps of the coarse model; the
                      joint training keeps its own
    visits            visits_of_blocks: a block visits its views alike, with as many steps in all
    thinning          find_sizes: surroundings smaller than a pixel are all kept; --workers 1,
                      as blocks in other processes would thin at exchanges: its time compares with
                      that of sharing
    exchanges         --exchanges 0 without the joint training; exchanges-on: 3 with it
    joint training    the column `joint` (--joint-steps none)
    sharing           --workers 1: nothing changes but the time
"""

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.evaluation.run import Run
from clsplat.io.runs.run import RunFolder
from tools.studies.study import Scene, flags_after

SCORES = ("psnr", "psnr_cc", "ssim")
NO_JOINT = "none"


def without_dense(_: Any) -> Callable[..., Any]:
    """In place of `filled`: the start as it was."""
    return lambda start, *arguments, **named: start


def equal_visits(visits_of_blocks: Any) -> Callable[..., Any]:
    """In place of `visits_of_blocks`: as many visits in all, each view as often."""
    return lambda *arguments: [np.full(len(visits), visits.mean()) for visits in visits_of_blocks(*arguments)]


def unthinned(find_sizes: Any) -> Callable[..., Any]:
    """In place of `find_sizes`: a pixel or more, or 0 where no view shows a gaussian."""

    def found(*arguments: Any) -> Any:
        reached, sizes = find_sizes(*arguments)
        return reached, (sizes > 0).astype(float)

    return found


# mechanism -> (module, name, what makes the substitute of the function there)
PATCHES: dict[str, tuple[str, str, Callable[[Any], Any]]] = {
    "dense": ("clsplat.cities.cut", "filled", without_dense),
    "visits": ("clsplat.cities.cut", "visits_of_blocks", equal_visits),
    "thinning": ("clsplat.cities.choose", "find_sizes", unthinned),
}
# mechanism -> flags; those that are of use with a joint training alone, or without one alone
FLAGS = {
    "none": (),
    "sharing": ("--workers", "1"),
    "thinning": ("--workers", "1"),
    "exchanges": ("--exchanges", "0"),
    "exchanges-on": ("--exchanges", "3"),
}
ONLY = {"exchanges": False, "exchanges-on": True}  # with a joint training, or without one
MECHANISMS = tuple(dict.fromkeys((*FLAGS, *PATCHES)))


def main(argv: list[str]) -> None:
    """Train the cities that are missing, and print a line for each."""
    words, flags = flags_after(argv)
    arguments = _parser().parse_args(words)
    arguments.out.mkdir(parents=True, exist_ok=True)
    file = arguments.out / "city_ablation.jsonl"
    known = (
        {_key(record): record for record in map(json.loads, file.read_text().splitlines())} if file.is_file() else {}
    )
    for scene in arguments.scenes:
        for seed in range(arguments.seeds):
            for joint in arguments.joint:
                for off in arguments.off:
                    if ONLY.get(off, joint) != joint:
                        continue
                    key = off, scene.name, joint, seed
                    if key not in known:
                        known[key] = trained(
                            arguments.out, scene, off, joint, seed, [f"--grid={arguments.grid}", *flags]
                        )
                        with open(file, "a", encoding="utf-8") as lines:
                            lines.write(json.dumps(known[key]) + "\n")
                    print(json.dumps(known[key]), flush=True)


def trained(out: Path, scene: Scene, off: str, joint: bool, seed: int, flags: list[str]) -> dict[str, Any]:
    """Train a city without the mechanism `off`, on request with a `joint` training at its end; it
    begins anew if it was stopped. Returns its line."""
    folder = out / scene.name / f"{off}.{'joint' if joint else 'blocks'}.{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    words = [
        scene.path,
        "-o",
        folder,
        "-q",
        "-r",
        f"{scene.downscale:g}",
        "--seed",
        seed,
        "--joint-steps",
        "0.5" if joint else NO_JOINT,
        *FLAGS.get(off, ()),
        *flags,
    ]
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "tools.studies.city_ablation", "city", off, *map(str, words)], check=False
    )
    seconds = round(time.perf_counter() - begin, 2)
    record: dict[str, Any] = {
        "off": off,
        "scene": scene.name,
        "joint": joint,
        "seed": seed,
        **dict.fromkeys((*SCORES, "gaussians")),
        "seconds": seconds,
        "flags": flags,
    }
    if done.returncode:
        return {**record, "failed": done.returncode}
    run = Run.open(folder)
    found = [each for each in RunFolder(folder).records() if each["event"] == "eval"][-1]
    return {
        **record,
        **{key: found[key] for key in (*SCORES, "gaussians")},
        "device": run.record.get("opencl_device"),
        "commit": run.record.get("commit"),
    }


def city(off: str, words: list[str]) -> None:
    """`clsplat city` with a mechanism off, in this process."""
    from clsplat.cli.main import main as clsplat

    if off in PATCHES:
        module, name, substitute = PATCHES[off]
        where = import_module(module)
        setattr(where, name, substitute(getattr(where, name)))
    clsplat(["city", *words])


def _key(record: dict[str, Any]) -> tuple[str, str, bool, int]:
    return record["off"], record["scene"], record["joint"], record["seed"]


def _parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("out", type=Path, help="folder of cities and results")
    made.add_argument("scenes", nargs="+", type=Scene, metavar="SCENE[:DOWNSCALE]")
    made.add_argument("--grid", default="2x2", help="of the blocks; default 2x2")
    made.add_argument("--seeds", type=int, default=1, help="how many; default 1")
    made.add_argument(
        "--off",
        nargs="+",
        choices=MECHANISMS,
        default=MECHANISMS,
        help="mechanisms; default: all, and `none`, with which they are compared",
    )
    made.add_argument(
        "--joint",
        nargs="+",
        type=lambda text: {"yes": True, "no": False}[text],
        default=(True, False),
        metavar="yes|no",
        help="default: yes no",
    )
    return made


if __name__ == "__main__":
    if sys.argv[1:2] == ["city"]:
        city(sys.argv[2], sys.argv[3:])
    else:
        main(sys.argv[1:])
