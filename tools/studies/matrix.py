"""Trains scenes with several schedules and seeds; OUT/matrix.md says how they compare.

    python -m tools.studies.matrix OUT SCENE[:DOWNSCALE] ... [--schedules sig,constant,dash,taming]

The equal time of a scene is that of its shortest run. gsplat 1.5.3, with whose figures ours are
compared, never resets opacities (its condition `step % reset_every == 0 & step > 0` is always
false): `--schedules constant -- --reset-every none` does the same.
"""

import shlex

import numpy as np

from clsplat.errors import InputError
from clsplat.report.curves import curve, spread, value_at
from clsplat.report.page import Table
from tools.studies.evidence import (
    NOTE,
    SCORES,
    TITLES,
    cell,
    complete,
    mean,
    measured,
    outermost,
    parsed,
    parser,
    refuse,
    score_cells,
    write,
)
from tools.studies.runs import trained, wanted

STOPS = "500,1000,2000,3000,4000,5000,6000,10000,15000,20000,25000"
BASE = "constant"  # the schedule that others are set against


def main(argv):
    made = parser(__doc__, 7000)
    made.add_argument("--seeds", type=int, default=3, help="default 3")
    made.add_argument("--schedules", default="sig,constant,dash,taming")
    made.add_argument("--also", action="append", default=[], metavar="'NAME: FLAGS'",
                      help="a column more; repeatable")
    made.add_argument("--eval-at", type=numbers, default=STOPS, help=f"default {STOPS}")
    given = parsed(made, argv)
    columns = {name: ["--schedule", name] for name in given.schedules.split(",")}
    for text in given.also:
        name, colon, flags = text.partition(":")
        if not colon:
            raise InputError(f"--also {text}: expects a name, a colon and flags, such as "
                             "'constant+exposure: --schedule constant --exposure on'")
        columns[name.strip()] = shlex.split(flags)
    stops = [str(stop) for stop in given.eval_at if stop < given.steps]
    evaluations = ["--eval-at", ",".join(stops)] if stops else []
    groups, failed = trained(
        [wanted(given, scene, name, seed, [*evaluations, *flags]) for seed in range(given.seeds)
         for scene in given.scenes for name, flags in columns.items()], given.jobs, given.gpus)
    write(given.out / "matrix.md", "Schedules", given, groups,
          [mean_table(groups), *(scene_table(*found) for found in groups.items()),
           step_table(groups)])
    refuse(failed)


def numbers(text):
    """The whole numbers of a list with commas."""
    return [int(word) for word in text.split(",")]


def at_equal_time(found):
    """(seconds, {group: PSNR cc of each run then}) of a scene: training seconds of its shortest
    run; linear between evaluations, runs without one by then left out."""
    lines = {name: [curve(run.records, "train_seconds", "psnr_cc", "eval") for run in runs]
             for name, runs in found.items()}
    seconds = min((x[-1] for group in lines.values() for x, _ in group if len(x)), default=np.nan)
    values = {name: [value_at(line, seconds) for line in group] for name, group in lines.items()}
    return float(seconds), {name: [value for value in group if value is not None]
                            for name, group in values.items()}


def scene_table(scene, found):
    """The end of the runs of one scene: a row a schedule."""
    seconds, equal = at_equal_time(found)
    rows = [(name, str(len(runs)), *score_cells(runs), cell(*spread(equal[name]), 2))
            for name, runs in found.items()]
    then = f"PSNR cc at {cell(seconds, None, 1)} s, dB"
    return Table(scene, ("schedule", "runs", *TITLES, then), rows, range(1, 9), (NOTE,))


def mean_table(groups):
    """Means over scenes, and what each schedule is against BASE, or the first where it is out."""
    scenes = complete(groups)
    names = list(next(iter(groups.values())))
    base = BASE if BASE in names else names[0]
    left_out = len(groups) - len(scenes)
    return Table(
        f"Means over {len(scenes)} scene{'s' if len(scenes) != 1 else ''}, against {base}",
        ("schedule", *TITLES[:4], "PSNR cc at equal time, dB", "PSNR cc more, dB",
         "gaussians, ratio", "training, ratio"),
        [(name, *_mean_cells(name, base, scenes)) for name in names if scenes], range(1, 9),
        ("Ratios are geometric means. The equal time of a scene is that of its shortest run; "
         "PSNR then is linear between evaluations.",
         *([f"{left_out} left out: a schedule has no run there."] if left_out else [])))


def _mean_cells(name, base, scenes):
    own, others = ([{key: mean(found[column], key) for _, key, _ in SCORES} for found in scenes]
                   for column in (name, base))
    equal = [np.mean(at_equal_time(found)[1][name] or [np.nan]) for found in scenes]
    more = [one["psnr_cc"] - other["psnr_cc"] for one, other in zip(own, others)]
    ratios = [np.exp(np.mean([np.log(one[key] / other[key]) for one, other in zip(own, others)]))
              for key in ("gaussians", "train_seconds")]
    return (*(cell(np.mean([one[key] for one in own]), None, digits)
              for _, key, digits in SCORES[:4]),
            cell(np.mean(equal), None, 2), cell(np.mean(more), None, 2, "+"),
            *(cell(ratio, None, 2) for ratio in ratios))


def step_table(groups):
    """Every evaluation: a row a scene, schedule and step."""
    rows = []
    for scene, found in groups.items():
        for name, runs in found.items():
            steps = sorted({record["iteration"] for run in runs for record in run.records
                            if record.get("event") == "eval"})
            rows += [(scene, name, str(step), str(len(measured(runs, "psnr_cc", step))),
                      *score_cells(runs, step)) for step in steps]
    return Table("By step", ("scene", "schedule", "step", "runs", *TITLES), rows, range(2, 10),
                 (NOTE,))


if __name__ == "__main__":
    outermost(main)
