"""The arguments and the tables of the studies."""

import argparse
import sys
from pathlib import Path

import numpy as np

from clsplat.cli.main import verdict
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.report.groups import warnings
from tools.studies.runs import Scene


def parser(doc, steps):
    """An ArgumentParser with the arguments of all studies that train."""
    result = argparse.ArgumentParser(description=doc, epilog="Flags of `clsplat train` for all "
                                     "runs may follow after --.",
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    result.add_argument("out", type=Path, help="folder of the runs and the results")
    result.add_argument("scenes", nargs="+", type=Scene, metavar="SCENE[:DOWNSCALE]")
    result.add_argument("-n", dest="steps", type=int, default=steps, help=f"default {steps}")
    result.add_argument("--jobs", type=int,
                        help="number of runs at a time (default: 1, or one for each GPU)")
    result.add_argument("--gpus", type=int, default=0, help="number of NVIDIA GPUs for the runs; "
                        "0 leaves CUDA_VISIBLE_DEVICES as it is")
    return result


def parsed(parser, argv):
    """The arguments; those that follow -- are `flags`."""
    words, flags = flags_after(argv)
    arguments = parser.parse_args(words, argparse.Namespace(flags=flags))
    arguments.jobs = arguments.jobs or max(1, arguments.gpus)
    return arguments


def flags_after(argv):
    """The words of a command before --, and those after it, flags of `clsplat train`."""
    cut = argv.index("--") if "--" in argv else len(argv)
    return argv[:cut], argv[cut + 1:]


def cell(value, deviation, digits, sign=""):
    """A number with its deviation as text; None and nan are -."""
    if value is None or np.isnan(value):
        return "-"
    more = "" if deviation is None or np.isnan(deviation) else f" ± {deviation:,.{digits}f}"
    return f"{value:{sign},.{digits}f}{more}"


def markdown(table):
    """A `report.page.Table` as Markdown."""
    def row(cells):
        return f"| {' | '.join(text.replace('|', '/') for text in cells)} |"
    rule = [("---:" if column in table.numbers else "---") for column in range(len(table.head))]
    lines = [row(table.head), row(rule), *map(row, table.rows)]
    return "\n\n".join([f"### {table.title}", "\n".join(lines), *table.notes])


def write(path, title, arguments, groups, tables):
    """Write tables to a Markdown file, and print them in reverse order.

    Parameters
    ----------
    arguments : the result of `parsed`.
    groups : scene -> group -> all runs that were read.
    tables : the most important one first.
    """
    runs = [run for scene in groups.values() for group in scene.values() for run in group]
    facts = [f"{arguments.steps:,} steps, {len(runs)} runs, at most {arguments.jobs} at a time on "
             f"{arguments.gpus or 1} device{'s' if arguments.gpus > 1 else ''}"]
    for key, label in (("opencl_device", ""), ("kernel_form", "form "), ("commit", "commit ")):
        values = sorted({str(run.options.get(key)) for run in runs})
        facts.append(label + " / ".join(values))
    if arguments.flags:
        facts.append(f"flags {' '.join(arguments.flags)}")
    scenes_of = {}
    for name, scene in groups.items():
        for text in warnings({group: runs for group, runs in scene.items() if runs}):
            scenes_of.setdefault(text, []).append(name)
    lines = [f"warning: {'' if len(names) == len(groups) else ', '.join(names) + ': '}{text}"
             for text, names in scenes_of.items()]
    if arguments.jobs > max(1, arguments.gpus):
        lines.append("warning: Runs shared a device, so their times are not reliable.")
    parts = [f"# {title}", f"{'; '.join(facts)}.", *lines]
    with replacing(path) as file:
        file.write(("\n\n".join([*parts, *map(markdown, tables)]) + "\n").encode())
    print("\n\n".join(["", *(table.text() for table in reversed(tables)), *lines, f"{path}"]))


def refuse(failed):
    """Raise InputError if runs failed; called after everything else is written."""
    if failed:
        raise InputError(f"{', '.join(map(str, failed))}: failed for the reasons above; the same "
                         "command tries them again")


def outermost(main):
    """Run `main` with the arguments of the command; an error that the user can cure is one line."""
    try:
        main(sys.argv[1:])
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (the outermost place)
        message, code = verdict(error)
        if code == 1:
            raise
        print(message, file=sys.stderr)
        sys.exit(code)
