"""A training whose harmonics are in pages, beside one with room for all.

    python -m tools.studies.paging OUT SCENE [--gaussians 20000000] [--steps 3600]
        [--budgets none,8GiB] [--keep PAGE] [-- FLAGS of clsplat train]

Training begins at copies of the scene's sparse points, at full resolution and with all harmonics;
none is added or removed. The time of a step is told apart for the first visit of the photos, in
which it is not known yet which pages they want, and for the steps of which the mean is taken.
"""

import argparse
import filecmp
import shlex
from itertools import pairwise
from pathlib import Path

import numpy as np

from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import write_ply
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import TrainOptions
from clsplat.report.page import Table
from tools.studies.study import flags_after, keep, keeps, markdown, outermost, timed_training

TITLE = "Harmonics in pages"
HEAD = (
    "memory budget",
    "gaussians",
    "first visits, ms",
    "ms a step",
    "with the mean, ms",
    "all steps, s",
    "times",
    "whole command, s",
    "device memory at most, GiB",
    "same bytes",
)
CONFIG = 'engine = "coded"\nsh_every = 1\nlevels = [1.0]\n'
GIB = 2**30


def write_start(scene, count, path):
    """Write `count` gaussians, copies of those at the sparse points, smaller and moved a little."""
    sparse, rng = Gaussians.from_points(scene.points, scene.colours, 0), np.random.default_rng(0)
    chosen = rng.integers(0, sparse.count, count)
    rows = {name: values[chosen] for name, values in sparse.rows.items()}
    rows["positions"] += np.exp(rows["log_scales"]) * rng.standard_normal((count, 3), np.float32)
    rows["log_scales"] -= 0.5 * np.log(count / sparse.count).astype(np.float32)
    write_ply(path, Gaussians(rows, 0), scene.offset)


def step_times(run, photos, steps):
    """Milliseconds of a step: of first visits, of later ones, and while the mean is taken; and
    seconds of all steps."""
    records = list(RunFolder(run).records())
    times = [(record["iteration"], record["train_seconds"]) for record in records if record["event"] == "step"]
    averaged = (1 - TrainOptions().average) * steps
    parts = [[], [], []]
    for (first, began), (last, ended) in pairwise(times):
        part = 0 if last <= photos else 2 if first >= averaged else 1
        parts[part].append(1000 * (ended - began) / (last - first))
    spent = [record for record in records if record["event"] == "time"][-1]["seconds"]
    return *(np.mean(part) for part in parts), spent["steps"], records[-2]["peak_bytes"]


def measured(scene, output, count, steps, budgets, flags):
    """A row for each budget."""
    output.mkdir(parents=True, exist_ok=True)
    start, config = output / "start.ply", output / "config.toml"
    write_start(scene, count, start)
    config.write_text(f"{CONFIG}densify_until = 1\n", "utf-8")
    rows, first = [], None
    for budget in budgets:
        run = output / budget
        seconds = timed_training(
            scene.path,
            run,
            [
                "-n",
                str(steps),
                "--init",
                str(start.resolve()),
                "--config",
                str(config.resolve()),
                "--memory-budget",
                budget,
                "--test-every",
                "none",
                *flags,
            ],
        )
        *each, whole, peak = step_times(run, len(scene.views), steps)
        model = RunFolder(run).model_path
        first = first or (whole, model)
        rows.append(
            (
                budget,
                f"{count:,}",
                *(f"{value:.2f}" for value in each),
                f"{whole:.1f}",
                f"{whole / first[0]:.2f}",
                f"{seconds:.0f}",
                f"{peak / GIB:.2f}",
                "yes" if filecmp.cmp(model, first[1], shallow=False) else "no",
            )
        )
        print(*rows[-1], sep="  ", flush=True)
    return Table(TITLE, HEAD, rows, range(1, 9), ())


def main(argv):
    """Train with each budget and print the table."""
    words, flags = flags_after(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--gaussians", type=int, default=20_000_000)
    parser.add_argument("--steps", type=int, default=3600)
    parser.add_argument("--budgets", default="none,8GiB")
    keeps(parser)
    options = parser.parse_args(words)
    scene = read_scene(options.scene)
    table = measured(scene, options.output, options.gaussians, options.steps, options.budgets.split(","), flags)
    print(markdown(table))
    device = RunFolder(options.output / options.budgets.split(",")[0]).read_options()
    keep(options.keep, [table], f"python -m tools.studies.paging {shlex.join(argv)}", device["opencl_device"])


if __name__ == "__main__":
    outermost(main)
