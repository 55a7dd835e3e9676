"""What the tools that make evidence share at both ends: their arguments, and their tables."""

import argparse
import sys
from pathlib import Path

import numpy as np

from clsplat.cli.main import verdict
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.report.curves import spread
from clsplat.report.groups import warnings
from tools.studies.runs import Scene

# of an evaluation: title, key, digits
SCORES = (("PSNR cc, dB", "psnr_cc", 2), ("PSNR, dB", "psnr", 2), ("SSIM cc", "ssim_cc", 4),
          ("SSIM", "ssim", 4), ("gaussians", "gaussians", 0), ("training, s", "train_seconds", 1))
TITLES = tuple(title for title, _, _ in SCORES)
NOTE = ("Held-out views; cc: after a quadratic fit of each render's colours to its photo. ± is the "
        "standard deviation over seeds.")


def parser(doc, steps):
    """An ArgumentParser of what all tools take."""
    made = argparse.ArgumentParser(description=doc, epilog="Flags of `clsplat train` for all runs "
                                   "may follow after --.",
                                   formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("out", type=Path, help="folder of the runs and of what is made of them")
    made.add_argument("scenes", nargs="+", type=Scene, metavar="SCENE[:DOWNSCALE]")
    made.add_argument("-n", dest="steps", type=int, default=steps, help=f"default {steps}")
    made.add_argument("--jobs", type=int, help="runs at a time (default: 1, or one a GPU)")
    made.add_argument("--gpus", type=int, default=0, help="NVIDIA GPUs to spread the runs over; 0 "
                      "leaves CUDA_VISIBLE_DEVICES alone")
    return made


def parsed(made, argv):
    """The parser's namespace; what follows -- is its `flags`."""
    cut = argv.index("--") if "--" in argv else len(argv)
    found = made.parse_args(argv[:cut], argparse.Namespace(flags=argv[cut + 1:]))
    found.jobs = found.jobs or max(1, found.gpus)
    return found


def measured(runs, key, iteration=None):
    """What each Trained had of `key` at its last evaluation, or the one after a given step; runs
    without are left out."""
    found = []
    for run in runs:
        values = [record[key] for record in run.records if record.get("event") == "eval"
                  and iteration in (None, record["iteration"]) and record.get(key) is not None]
        found += values[-1:]
    return found


def mean(runs, key):
    """Over seeds; nan where nothing was measured."""
    return float(np.mean(measured(runs, key) or [np.nan]))


def cell(value, deviation, digits, sign=""):
    """A number as text, with what it may vary by; None and nan are -."""
    if value is None or np.isnan(value):
        return "-"
    more = "" if deviation is None or np.isnan(deviation) else f" ± {deviation:,.{digits}f}"
    return f"{value:{sign},.{digits}f}{more}"


def score_cells(runs, iteration=None):
    """Cells for TITLES: means over seeds, after the last step or a given one."""
    return [cell(*spread(measured(runs, key, iteration)), digits) for _, key, digits in SCORES]


def complete(groups):
    """The scenes, {group: list of Trained} each, in which every group has a run; what means over
    scenes may be taken of."""
    return [found for found in groups.values() if all(found.values())]


def markdown(table):
    """A report.page.Table as Markdown."""
    def row(cells):
        return f"| {' | '.join(text.replace('|', '/') for text in cells)} |"
    rule = [("---:" if column in table.numbers else "---") for column in range(len(table.head))]
    lines = [row(table.head), row(rule), *map(row, table.rows)]
    return "\n\n".join([f"### {table.title}", "\n".join(lines), *table.notes])


def write(path, title, given, groups, tables):
    """Print tables, the most important one last, and write them to a Markdown file, that one first.

    given: namespace of `parsed`; groups: {scene: {group: list of Trained}}, all that was read.
    """
    runs = [run for found in groups.values() for group in found.values() for run in group]
    facts = [f"{given.steps:,} steps, {len(runs)} runs, at most {given.jobs} at a time on "
             f"{given.gpus or 1} device{'s' if given.gpus > 1 else ''}"]
    for key, of in (("opencl_device", ""), ("kernel_form", "form "), ("commit", "commit ")):
        values = sorted({str(run.options.get(key)) for run in runs})
        facts.append(of + " / ".join(values))
    if given.flags:
        facts.append(f"flags {' '.join(given.flags)}")
    where = {}
    for name, scene in groups.items():
        for text in warnings({group: of_group for group, of_group in scene.items() if of_group}):
            where.setdefault(text, []).append(name)
    found = [f"warning: {'' if len(names) == len(groups) else ', '.join(names) + ': '}{text}"
             for text, names in where.items()]
    if given.jobs > max(1, given.gpus):
        found.append("warning: Runs shared a device: their times mean little.")
    parts = [f"# {title}", f"{'; '.join(facts)}.", *found]
    with replacing(path) as file:
        file.write(("\n\n".join([*parts, *map(markdown, tables)]) + "\n").encode())
    print("\n\n".join(["", *(table.text() for table in reversed(tables)), *found, f"{path}"]))


def refuse(failed):
    """InputError if runs failed, at the end, when what there is has been written."""
    if failed:
        raise InputError(f"{', '.join(map(str, failed))}: failed, for the reasons above; the same "
                         "command tries again")


def outermost(main):
    """Run main(arguments); an error that the user can cure is one line."""
    try:
        main(sys.argv[1:])
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (the outermost place)
        message, code = verdict(error)
        if code == 1:
            raise
        print(message, file=sys.stderr)
        sys.exit(code)
