"""The matplotlib figures of the reports, which need no window system.

Each is drawn within `drawing.own_settings`. A `narrow` figure is for a telephone: its panels are
one below the other.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator

from clsplat.report.curves import Curve, Record, band, curve
from clsplat.report.drawing import LABEL_COLOUR
from clsplat.report.groups import Trained
from clsplat.report.scores import UPHEAVALS, is_upheaval
from clsplat.schedule.plan import size_at

# Okabe and Ito (2008), distinct for the colour-blind; without yellow, which is too pale on white
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
DASHES = ("-", "--", ":", "-.")
WIDE, NARROW = 10, 4.4  # inches
CHANGE: dict[str, Any] = {"color": "#8b9095", "linewidth": 0.9, "linestyle": (0, (4, 3)),
                          "zorder": 0.5}  # the line at a change of the level


def comparison_figure(groups: Mapping[str, Sequence[Trained]], levels: Sequence[float],
                      narrow: bool = False) -> Figure | None:
    """Colour-corrected PSNR and SSIM, and the number of gaussians, over training time.

    Each group has a line at the mean of its runs, a band from the minimum to the maximum, and a dot
    at every evaluation.

    Parameters
    ----------
    levels : PSNR, dB, to mark.

    Returns
    -------
    None where no run was evaluated twice.
    """
    if not any(_is_curve(curve(run.records, "train_seconds", "psnr_cc", "eval"))
               for runs in groups.values() for run in runs):
        return None
    rows = len(groups) if narrow else -(-len(groups) // 4)  # of the legend
    figure = Figure(figsize=(NARROW if narrow else WIDE, 9.6 + 0.17 * rows), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True, height_ratios=(1.6, 1, 1))
    for number, (name, runs) in enumerate(groups.items()):
        for axes, key, event in zip(panels, ("psnr_cc", "ssim_cc", "gaussians"),
                                    ("eval", "eval", None)):
            lines = [curve(run.records, "train_seconds", key, event) for run in runs]
            _draw_band(axes, lines, name, number, dots=event)
    titles = ("PSNR after the colour fit, dB", "SSIM after the colour fit", "gaussians")
    for axes, title in zip(panels, titles):
        axes.set_title(title)
    for level in levels:
        panels[0].axhline(level, color="#b9bdc1", linewidth=0.8, linestyle=(0, (4, 4)),
                          zorder=0.5)
    panels[2].yaxis.set_major_formatter(EngFormatter(sep=" "))
    panels[2].set_ylim(bottom=0)
    panels[2].set_xlim(left=0)
    panels[2].set_xlabel("training time, s")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left",
                  ncols=1 if narrow else min(len(groups), 4))
    return figure


def cost_figure(groups: Mapping[str, Sequence[Trained]], narrow: bool = False) -> Figure | None:
    """Colour-corrected PSNR over costs that do not depend on the machine.

    The costs are pairs of gaussian and pixel, and bytes. None where no run has counted them twice.
    """
    axes_of = (("pixel_pairs", "pairs of gaussian and pixel"),
               ("kernel_bytes", "bytes of the arrays given to kernels"))
    lines = {key: {name: [curve(run.records, key, "psnr_cc", "eval") for run in runs]
                   for name, runs in groups.items()} for key, _ in axes_of}
    if not any(_is_curve(line) for by_name in lines.values() for group in by_name.values()
               for line in group):
        return None
    figure, panels = _two_panels(narrow, 4, sharey=True)
    for axes, (key, label) in zip(panels, axes_of):
        for number, (name, group) in enumerate(lines[key].items()):
            _draw_band(axes, group, name, number, dots=True)
        axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.set_xlim(left=0)
        axes.set_xlabel(label)
    for axes in panels if narrow else panels[:1]:
        axes.set_title("PSNR after the colour fit, dB")
    panels[1].legend(loc="lower right")
    return figure


def score_figure(records: Sequence[Record], narrow: bool = False) -> Figure | None:
    """PSNR and SSIM over training time, plain and after the colour fit, and what lowers them.

    None with fewer than two evaluations.
    """
    if not any(_is_curve(curve(records, "train_seconds", key, "eval")) for key in ("psnr", "ssim")):
        return None
    figure, panels = _two_panels(narrow, 3.3)
    for axes, key, title in zip(panels, ("psnr", "ssim"), ("PSNR, dB", "SSIM")):
        for suffix, label, colour in (("_cc", "after the colour fit", COLOURS[0]),
                                      ("", "plain", COLOURS[1])):
            axes.plot(*curve(records, "train_seconds", key + suffix, "eval"), ".-",
                      color=colour, label=label)
        _mark_upheavals(axes, records)
        axes.set_title(title)
        axes.set_xlim(left=0)
        axes.set_xlabel("training time, s")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left",
                  ncols=2 if narrow else 5)
    return figure


def step_figure(records: Sequence[Record], narrow: bool = False) -> Figure | None:
    """Gaussians, loss and, where it changes, level over iterations; None without a curve."""
    gaussians, loss, level = (curve(records, "iteration", key)
                              for key in ("gaussians", "loss", "level"))
    if not _is_curve(loss):  # a city takes no steps itself
        return None
    changes = len(set(level[1])) > 1
    figure = Figure(figsize=(NARROW if narrow else WIDE, 7 if changes else 5),
                    layout="constrained")
    panels = figure.subplots(2 + changes, 1, sharex=True,
                             height_ratios=(1.3, 1.3, 0.8)[:2 + changes])
    panels[0].plot(*gaussians, color=COLOURS[0], drawstyle="steps-post")
    panels[0].set_title("gaussians")
    panels[0].yaxis.set_major_formatter(EngFormatter(sep=" "))
    panels[0].set_ylim(bottom=0)
    panels[1].plot(*loss, color=COLOURS[0])
    panels[1].set_title("loss")
    _logarithmic(panels[1])
    if changes:
        panels[2].plot(*level, color=COLOURS[0], drawstyle="steps-post")
        panels[2].set_title("level: how many times smaller the images are")
        panels[2].set_ylim(0, max(level[1]) * 1.15)
        panels[2].yaxis.set_major_locator(MaxNLocator(5, integer=True))
    for axes in panels:
        _mark_changes(axes, records, named=axes is panels[0])
    panels[-1].set_xlim(left=0)
    panels[-1].set_xlabel("iteration")
    return figure


def _is_curve(line: Curve) -> bool:
    """Whether the points of a curve differ in x."""
    return len(set(line[0])) > 1


def _two_panels(narrow: bool, height: float, sharey: bool = False) -> tuple[Figure, Any]:
    """A figure and its two axes, side by side or, if it is narrow, one below the other."""
    if narrow:
        figure = Figure(figsize=(NARROW, 1.75 * height), layout="constrained")
        return figure, figure.subplots(2, 1)
    figure = Figure(figsize=(WIDE, height), layout="constrained")
    return figure, figure.subplots(1, 2, sharey=sharey)


def _draw_band(axes: Axes, lines: Sequence[Curve], name: str, number: int, dots: object) -> None:
    """Draw the mean, the range and, if wanted, the points of the curves of group `number`."""
    colour = COLOURS[number % len(COLOURS)]
    x, mean, low, high = band(lines)
    axes.plot(x, mean, label=name, color=colour,
              linestyle=DASHES[number // len(COLOURS) % len(DASHES)])
    axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
    for line in lines if dots else ():
        axes.plot(*line, ".", color=colour, markersize=4, alpha=0.6)


def _logarithmic(axes: Axes) -> None:
    """Make the y axis logarithmic, with numbers also where it spans less than a decade."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter("")


def _mark_upheavals(axes: Axes, records: Sequence[Record]) -> None:
    """Draw a line at each change of the level, and a mark at the bottom for each round of growth
    and each reset of opacities."""
    found = [record for record in records if is_upheaval(record)
             and record.get("train_seconds") is not None]
    times = {event: [record["train_seconds"] for record in found if record["event"] == event]
             for event in UPHEAVALS}
    for number, time in enumerate(times["level"]):
        axes.axvline(time, label="" if number else "larger photos begin", **CHANGE)
    for event, marker, label in (("grow", "|", "gaussians added"),
                                 ("reset", "v", "opacities lowered")):
        if times[event]:
            axes.plot(times[event], [0.02] * len(times[event]), marker, label=label, markersize=6,
                      color=LABEL_COLOUR, transform=axes.get_xaxis_transform(), clip_on=False)


def _mark_changes(axes: Axes, records: Sequence[Record], named: bool) -> None:
    """Draw a vertical line at each level change, with the new size of photos beside it if `named`.
    """
    for number, (iteration, level) in enumerate(zip(*curve(records, "iteration", "level",
                                                           "level"))):
        axes.axvline(iteration, **CHANGE)
        if named:
            axes.annotate(size_at(level), (iteration, 1), xycoords=("data", "axes fraction"),
                          xytext=(3, -2 - 11 * (number % 2)), textcoords="offset points",
                          va="top", fontsize=9, color=LABEL_COLOUR)
