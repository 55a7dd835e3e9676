"""Which scene frequency shows when to change the level: train scenes at five fixed resolutions.

    python -m tools.studies.effectiveness OUT SCENE[:DOWNSCALE] ...

Factors are relative to SCENE at DOWNSCALE. OUT/SCENE/effectiveness.png has the nine frequencies
over iterations, with a line for each resolution, like the figure of Xue et al. (2026);
OUT/effectiveness.md says for each frequency whether it orders the resolutions and whether it
saturates.
"""

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from clsplat.io.atomic import replacing
from clsplat.report.curves import frequency_curves, value_at
from clsplat.report.drawing import own_settings
from clsplat.report.page import Table
from clsplat.training.frequency import AXES, VARIANTS
from tools.studies.evidence import outermost, parsed, parser, refuse, write
from tools.studies.runs import planned, trained

FACTORS = (5, 4, 3, 2, 1)
FLAGS = ("--schedule", "constant", "--reset-every", "0")
SATURATED = 0.1  # the last quarter may still add this share of the growth while densifying


def main(argv):
    """Train what is missing, and write the figures and the table."""
    arguments = parsed(parser(__doc__, 4000), argv)
    groups, failed = trained(
        [planned(arguments, scene, f"fixed{factor}", 0,
                 [*FLAGS, "-r", f"{factor * scene.downscale:g}"])
         for scene in arguments.scenes for factor in FACTORS], arguments.jobs, arguments.gpus)
    rows = []
    for scene, by_name in groups.items():
        runs = {factor: by_name[f"fixed{factor}"][0] for factor in FACTORS
                if by_name[f"fixed{factor}"]}
        lines = {factor: frequency_curves(run.records) for factor, run in runs.items()}
        grows = next(iter(growing(run.options) for run in runs.values()), None)
        with replacing(arguments.out / scene / "effectiveness.png") as file:
            drawn(scene, lines, grows).savefig(file, format="png", dpi=150)
        for variant in VARIANTS:
            for axis in AXES:
                chosen = [line[variant][axis] for line in lines.values()
                          if axis in line.get(variant, {})]
                rows.append((scene, f"{variant} {axis}", *verdicts(chosen, grows)))
    table = Table(
        "Scene frequencies", ("scene", "frequency", "ordered at the end", "at half", "saturates",
                              "last quarter / growing", "at the end, coarse to fine"), rows, (), (
            "Ordered: each resolution has a higher frequency than the coarser one before it. "
            f"Saturates: the last quarter adds less than {SATURATED:g} of what was added while "
            "densifying; beside it is that share, the median of the resolutions and its range.",
            f"Fixed factors {', '.join(map(str, FACTORS))}; one seed."))
    # each run is a group, since the runs of a scene differ on purpose where `write` would warn
    alone = {f"{scene} {name}": {name: runs} for scene, by_name in groups.items()
             for name, runs in by_name.items()}
    write(arguments.out / "effectiveness.md", "Effectiveness of the scene frequency", arguments,
          alone, [table])
    refuse(failed)


def growing(options):
    """The first and the last step after which a run with these options may grow."""
    return options["densify_from"], options["densify_until"] or options["iterations"] // 2


def verdicts(lines, grows):
    """The cells of one frequency.

    Parameters
    ----------
    lines : curves over iterations, from the coarsest resolution to the finest.
    grows : the result of `growing`.
    """
    if len(lines) < 2:
        return ("-",) * 5
    end = min(x[-1] for x, _ in lines)
    last = [value_at(line, end) for line in lines]
    shares = [share for share in (late_share(line, end, grows) for line in lines)
              if share is not None]
    saturated = sum(abs(share) < SATURATED for share in shares)
    span = (f"{np.median(shares):.2f} ({min(shares):.2f} to {max(shares):.2f})" if shares else "-")
    return (ordered(last), ordered([value_at(line, end / 2) for line in lines]),
            _of(saturated, len(shares)), span, " ".join(f"{value:.3g}" for value in last))


def late_share(line, end, grows):
    """What the last quarter before `end` adds, over what densifying added; None if unknown or 0."""
    first, until = max(grows[0], line[0][0]), grows[1]
    points = [value_at(line, x) for x in (first, until, 0.75 * end, end)]
    if None in points or first >= until or points[1] == points[0]:
        return None
    return (points[3] - points[2]) / (points[1] - points[0])


def ordered(values):
    """How many neighbours in a list rise; "yes" if all do."""
    if None in values:
        return "-"
    return _of(sum(a < b for a, b in zip(values, values[1:])), len(values) - 1)


def _of(count, total):
    return "-" if not total else "yes" if count == total else f"{count} of {total}"


def drawn(scene, lines, grows):
    """The figure of a scene.

    Parameters
    ----------
    lines : factor -> variant -> axis -> curve.
    grows : the result of `growing`, or None.
    """
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(FACTORS)))
    with own_settings():
        figure = Figure(figsize=(11, 9), layout="constrained")
        panels = figure.subplots(len(VARIANTS), len(AXES), sharex=True)
        for row, variant in zip(panels, VARIANTS):
            for axes, axis in zip(row, AXES):
                for factor, colour in zip(FACTORS, colours):
                    if axis in lines.get(factor, {}).get(variant, {}):
                        axes.plot(*lines[factor][variant][axis], color=colour,
                                  label=f"{factor}x smaller" if factor > 1 else "full")
                if grows:
                    axes.axvline(grows[1], color="#8b9095", linewidth=0.9, linestyle=(0, (4, 3)))
                axes.set_title(f"{variant}, {axis}")
        for axes in panels[-1]:
            axes.set_xlabel("iteration")
        figure.suptitle(f"{scene}: scene frequency, 1 / world unit; dashed: growth ends")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center",
                      ncols=len(FACTORS))
    return figure


if __name__ == "__main__":
    outermost(main)
