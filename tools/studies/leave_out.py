"""The cost of each part of a training step; writes OUT/leave_out.md and OUT/leave_out.jsonl.

    python -m tools.studies.leave_out OUT SCENE[:DOWNSCALE][@VIEWS] ...

Times steps of the real training at full size on --gaussians gaussians around the sparse points:
with everything on, without each one of the parts, with everything off, and then with what some
scenes need in addition. @VIEWS uses only the first VIEWS photos of a scene. Each row has a device
of its own, so that its memory is that of the row, and the rows take steps in turn. The machine
should do nothing else:

    python -m tools.studies.leave_out out/leave ../shared/data/caliterra data_samples/city \\
        ../shared/data/caliterra@10
"""

import argparse
import dataclasses
import itertools
import json
import shlex
from pathlib import Path

import numpy as np

from clsplat.densify.sphere import with_spheres
from clsplat.device import choose_device
from clsplat.errors import InputError
from clsplat.estimate.trial_steps import TrialSteps, sampled, spread_out
from clsplat.io.atomic import replacing
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.report.page import Table
from clsplat.training.photos import Photos
from clsplat.training.session import Session
from clsplat.training.start.prepare import prepare
from tools.bench.timing import in_turn
from tools.studies.study import Scene, keep, keeps, markdown, outermost

ON, OFF = "everything on", "everything off"
# part -> (options with it, options without)
PARTS = {
    "harmonics": ({"sh_degree": 3}, {"sh_degree": 0}),
    "antialiasing": ({"antialiased": True}, {"antialiased": False}),
    "exposure": ({"exposure": "on"}, {"exposure": "off"}),
    "reprojection": ({"reproject": "on"}, {"reproject": "off"}),
    "spheres": ({"sphere": True}, {"sphere": False}),
    "growth statistics": ({}, {}),
}
ADDITIONS = {"moments on the host": {"engine": "numpy"}, "photos streamed": {}}
VIEWS = 10  # for the steps


def main(argv):
    """Time the steps and write the tables."""
    arguments = _parser().parse_args(argv)
    if arguments.gaussians < 2 or arguments.repeats < 1:
        raise InputError("--gaussians and --repeats: expect at least 2 and 1")
    scenes = [_scene(text) for text in arguments.scenes]
    arguments.out.mkdir(parents=True, exist_ok=True)
    records = []
    for name, scene in scenes:
        rows = [(row, *prepared(arguments, scene, options, parts)) for row, options, parts in variants()]
        times = in_turn([(device, step) for _, device, step in rows], arguments.repeats, warm_up=VIEWS)
        for (row, device, _), measured in zip(rows, times):
            records.append({"scene": name, "variant": row, **record(arguments, scene, device, measured)})
            print(json.dumps(records[-1]), flush=True)
        with replacing(arguments.out / "leave_out.jsonl") as file:
            file.writelines((json.dumps(record) + "\n").encode() for record in records)
    tables = [table(name, [r for r in records if r["scene"] == name]) for name, _ in scenes]
    command = f"python -m tools.studies.leave_out {shlex.join(argv)}"
    with replacing(arguments.out / "leave_out.md") as file:
        note = f"Made by `{command}`; do not edit."
        file.write("\n\n".join(["# The cost of parts of a step", note, *map(markdown, tables), ""]).encode())
    print(f"{arguments.out / 'leave_out.md'}")
    keep(arguments.keep, tables, command, records[0]["device"])


def _parser():
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("out", type=Path, help="folder of the results")
    made.add_argument("scenes", nargs="+", metavar="SCENE[:DOWNSCALE][@VIEWS]")
    made.add_argument("--gaussians", type=int, default=100_000, help="default 100000")
    made.add_argument("--repeats", type=int, default=40, help="number of timed steps for each row; default 40")
    keeps(made)
    made.add_argument("--device", default="auto")
    made.add_argument("--form", default="auto", choices=("auto", "item", "group"))
    return made


def variants():
    """The name, the options, and the names of the parts that are on, for each row."""

    def options(on):
        return {key: value for part, sides in PARTS.items() for key, value in sides[part not in on].items()}

    every = tuple(PARTS)
    yield ON, options(every), every
    for part in PARTS:
        rest = tuple(other for other in PARTS if other != part)
        yield f"without {part}", options(rest), rest
    yield OFF, options(()), ()
    for name, more in ADDITIONS.items():
        yield f"off, {name}", {**options(()), **more}, (name,)


def _scene(text):
    """The name and the scene of SCENE[:DOWNSCALE][@VIEWS]."""
    path, at, views = text.partition("@")
    if at and not (views.isdigit() and int(views) >= 2):
        raise InputError(f"{text}: expects a whole number of views, at least 2, after @")
    source = Scene(path)
    scene = read_scene(source.path).reduced(source.downscale)
    if not at:
        return source.name, scene
    kept = int(views)
    seen = scene.observations
    seen = None if seen is None else seen[seen[:, 1] < kept]
    return f"{source.name}@{views}", dataclasses.replace(scene, views=scene.views[:kept], observations=seen)


def prepared(arguments, scene, options, parts):
    """The device of a row, and a function that takes the next step on it."""
    device = choose_device(arguments.device, form=arguments.form)
    ready = prepare(scene, resolve({}, {"test_every": 0, "max_resolution": 0, **options}), device)
    gaussians = sampled(ready.scene, arguments.gaussians, ready.options.sh_degree)
    if ready.options.sphere:
        gaussians = with_spheres(gaussians, ready.options.sphere_neighbours)
    streamed = "photos streamed" in parts
    photos = Photos(device, ready.train_views, budget_bytes=0 if streamed else None)
    trial = TrialSteps(Session(ready, device, gaussians, photos=photos))
    trial.plan = dataclasses.replace(trial.plan, gathers="growth statistics" in parts)
    indices = spread_out(len(ready.train_views), VIEWS)
    regularises = ready.options.reproject == "on"
    taken = {} if streamed else {index: trial.prepare(index, regularises) for index in indices}

    def steps(index):
        (taken.get(index) or trial.prepare(index, regularises))()

    turns = itertools.cycle(indices)
    return device, lambda: steps(next(turns))


def record(arguments, scene, device, times):
    """The record of a row: median and quartiles of a step's milliseconds, and the device's MiB."""
    low, median, high = np.percentile(times, (25, 50, 75))
    camera = scene.views[0].camera
    return {
        "gaussians": arguments.gaussians,
        "views": len(scene.views),
        "width": camera.width,
        "height": camera.height,
        "device": device.name,
        "form": device.form,
        "driver": device.handle.driver_version,
        "median_ms": round(float(median), 3),
        "quartiles_ms": [round(float(low), 3), round(float(high), 3)],
        "repeats": len(times),
        "device_mib": round(device.memory_bytes / 2**20, 1),
    }


def table(name, records):
    """A row for each variant, with the difference to everything on."""
    full = next(record for record in records if record["variant"] == ON)
    rows = [
        (
            r["variant"],
            f"{r['median_ms']:.2f}",
            f"{r['quartiles_ms'][0]:.2f} to {r['quartiles_ms'][1]:.2f}",
            f"{full['median_ms'] / r['median_ms']:.2f}",
            f"{r['device_mib']:.0f}",
            f"{r['device_mib'] - full['device_mib']:+.0f}",
        )
        for r in records
    ]
    return Table(
        f"What parts of a step cost: {name}",
        (
            f"{full['width']}x{full['height']}, {full['gaussians']:,} gaussians",
            "ms a step",
            "quartiles",
            "times faster",
            "MiB",
            "to everything on",
        ),
        rows,
        range(1, 6),
        (
            f"{full['device']}, form {full['form']}, driver {full['driver']}; "
            f"{full['repeats']} steps for each row on at most {VIEWS} photos.",
        ),
    )


if __name__ == "__main__":
    outermost(main)
