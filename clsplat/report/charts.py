"""The charts of pages, by matplotlib: a chart is a function that returns a Figure, or None if there
is nothing to draw.

They are drawn from matplotlib's own defaults, whatever a user's settings are. A chart that cannot
be drawn becomes a line of text.
"""

import base64
import io
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator

from clsplat.evaluation.survey import Survey
from clsplat.report.scores import UPHEAVALS, Curve, Record, band, curve, is_upheaval
from clsplat.schedule.plan import size_at

LABEL_COLOUR = "#5c6166"
SETTINGS: dict[str, Any] = {  # of matplotlib
    "font.size": 10, "axes.titlesize": 10.5, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": "#8b9095", "axes.facecolor": "none", "axes.grid": True,
    "axes.axisbelow": True, "grid.color": "#e8e9ea", "xtick.color": LABEL_COLOUR,
    "ytick.color": LABEL_COLOUR, "axes.labelcolor": LABEL_COLOUR, "axes.linewidth": 0.8,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "text.parse_math": False,  # names of scenes may have dollar signs
    "svg.hashsalt": "clsplat",  # equal figures, equal bytes
}
# Okabe and Ito (2008), distinct for the colour-blind; without yellow, which is too pale on white
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
DASHES = ("-", "--", ":", "-.")
WIDTH = 10  # inches
HEIGHTS = (3.0, 7.0)  # inches, of a map
CHANGE: dict[str, Any] = {"color": "#8b9095", "linewidth": 0.9, "linestyle": (0, (4, 3)),
                          "zorder": 0.5}  # the line at a change of the level
Draw = Callable[..., Figure | None]


@contextmanager
def own_settings(**changes: Any) -> Iterator[None]:
    """Set matplotlib to its own defaults, SETTINGS and `changes`, and restore it afterwards.

    A figure must be made and saved within: some of its text is made when it is saved.
    """
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about deprecated defaults
        settings: Any = dict(matplotlib.rcParamsDefault)
        settings.update(SETTINGS, **changes)
        del settings["backend"]
        matplotlib.rcParams.update(settings)
        yield


def drawn(description: str, draw: Draw, *arguments: object) -> str:
    """HTML of a chart as SVG, "" if there is nothing to draw, or a line of text after an error.

    Parameters
    ----------
    description : the text for readers who cannot see the chart.
    draw : called with the arguments.
    """
    try:
        data = _saved(draw, arguments, format="svg", facecolor="none", metadata={"Date": None})
    except Exception as error:  # noqa: BLE001  (no drawing is worth a page)
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        return f"<p class=note>{escape(description)}: could not be drawn ({escape(reason)}).</p>\n"
    return data and (f'<div class="scroll chart"><img alt="{escape(description)}" '
                     f'src="data:image/svg+xml;base64,{base64.b64encode(data).decode()}"></div>\n'
                     ) or ""


def as_png(draw: Draw, *arguments: object) -> bytes | None:
    """A chart as PNG; None if there is nothing to draw."""
    return _saved(draw, arguments, format="png", dpi=150)


def _saved(draw: Draw, arguments: tuple[object, ...], **settings: Any) -> bytes | None:
    with own_settings():
        figure, file = draw(*arguments), io.BytesIO()
        if figure is None:
            return None
        figure.savefig(file, **settings)
    return file.getvalue()


def comparison_figure(groups: Mapping[str, Sequence[Sequence[Record]]], levels: Sequence[float]
                      ) -> Figure | None:
    """Colour-corrected PSNR and SSIM, and the number of gaussians, over training time.

    Each group has a line at the mean of its runs, a band from the minimum to the maximum, and a dot
    at every evaluation. None if no run was evaluated twice.

    Parameters
    ----------
    groups : name -> the records of its runs.
    levels : PSNR, dB, to mark.
    """
    if not any(_is_curve(curve(run, "train_seconds", "psnr_cc", "eval"))
               for runs in groups.values() for run in runs):
        return None
    figure, panels = _stacked(9.6 + 0.17 * -(-len(groups) // 4), (1.6, 1, 1), "training time, s")
    for axes, title, key, event in zip(
            panels, ("PSNR after the colour fit, dB", "SSIM after the colour fit", "gaussians"),
            ("psnr_cc", "ssim_cc", "gaussians"), ("eval", "eval", None)):
        axes.set_title(title)
        for number, (name, runs) in enumerate(groups.items()):
            lines = [curve(run, "train_seconds", key, event) for run in runs]
            colour = COLOURS[number % len(COLOURS)]
            x, mean, low, high = band(lines)
            axes.plot(x, mean, label=name, color=colour,
                      linestyle=DASHES[number // len(COLOURS) % len(DASHES)])
            axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
            for line in lines if event else ():
                axes.plot(*line, ".", color=colour, markersize=4, alpha=0.6)
    for level in levels:
        panels[0].axhline(level, color="#b9bdc1", linewidth=0.8, linestyle=(0, (4, 4)),
                          zorder=0.5)
    _count_axis(panels[2])
    panels[2].set_xlim(left=0)
    _legend_above(figure, panels[0], min(len(groups), 4))
    return figure


def score_figure(records: Sequence[Record]) -> Figure | None:
    """PSNR and SSIM over training time, plain and after the colour fit, and what lowers them.

    None with fewer than two evaluations.
    """
    if not any(_is_curve(curve(records, "train_seconds", key, "eval")) for key in ("psnr", "ssim")):
        return None
    figure = Figure(figsize=(WIDTH, 3.3), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, key, title in zip(panels, ("psnr", "ssim"), ("PSNR, dB", "SSIM")):
        for suffix, label, colour in (("_cc", "after the colour fit", COLOURS[0]),
                                      ("", "plain", COLOURS[1])):
            axes.plot(*curve(records, "train_seconds", key + suffix, "eval"), ".-",
                      color=colour, label=label)
        _mark_upheavals(axes, records)
        axes.set_title(title)
        axes.set_xlim(left=0)
        axes.set_xlabel("training time, s")
    _legend_above(figure, panels[0], 5)
    return figure


def step_figure(records: Sequence[Record]) -> Figure | None:
    """Gaussians, loss and, if it changes, level over iterations; None without a curve."""
    gaussians, loss, level = (curve(records, "iteration", key)
                              for key in ("gaussians", "loss", "level"))
    if not _is_curve(loss):  # a city takes no steps itself
        return None
    changes = len(set(level[1])) > 1
    figure, panels = _stacked(7 if changes else 5, (1.3, 1.3, 0.8)[:2 + changes], "iteration")
    panels[0].plot(*gaussians, color=COLOURS[0], drawstyle="steps-post")
    panels[0].set_title("gaussians")
    _count_axis(panels[0])
    panels[1].plot(*loss, color=COLOURS[0])
    panels[1].set_title("loss")
    panels[1].set_yscale("log")  # with numbers also if it spans less than a decade
    panels[1].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panels[1].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panels[1].yaxis.set_minor_formatter("")
    if changes:
        panels[2].plot(*level, color=COLOURS[0], drawstyle="steps-post")
        panels[2].set_title("level: how many times smaller the images are")
        panels[2].set_ylim(0, max(level[1]) * 1.15)
        panels[2].yaxis.set_major_locator(MaxNLocator(5, integer=True))
    for number, (iteration, value) in enumerate(zip(*curve(records, "iteration", "level",
                                                           "level"))):
        for axes in panels:
            axes.axvline(iteration, **CHANGE)
        panels[0].annotate(size_at(value), (iteration, 1), xycoords=("data", "axes fraction"),
                           xytext=(3, -2 - 11 * (number % 2)), textcoords="offset points",
                           va="top", fontsize=9, color=LABEL_COLOUR)
    panels[-1].set_xlim(left=0)
    return figure


def survey_figure(survey: Survey) -> Figure | None:
    """The cameras above the points, coloured by their residual, and the map of overlap."""
    if not np.isfinite(survey.cameras).all():
        return None
    shown = [survey.cameras]
    if len(survey.ground):
        shown.append(np.quantile(survey.ground, (0.01, 0.99), axis=0))
    places = np.concatenate(shown)
    low, high = places.min(axis=0), places.max(axis=0)
    room = 0.04 * float((high - low).max()) or 1.0
    (west, south), (east, north) = (low - room).tolist(), (high + room).tolist()
    count = 1 + (survey.overlap is not None)
    width = WIDTH / (count if count > 1 else 1.6)
    height = float(np.clip(0.8 * width * (north - south) / (east - west), *HEIGHTS))
    figure = Figure(figsize=(width * count, height + 0.3), layout="constrained")
    panels = figure.subplots(1, count, squeeze=False).ravel()
    _draw_cameras(figure, panels[0], survey)
    if survey.overlap is not None:
        counts = np.ma.masked_less(survey.overlap.counts, 0)
        image = panels[1].imshow(counts, origin="lower", extent=survey.overlap.bounds,
                                 cmap="cividis", vmin=0, interpolation="nearest", zorder=1)
        figure.colorbar(image, ax=panels[1], label="photos that look at a place", shrink=0.8,
                        ticks=MaxNLocator(6, integer=True))
        panels[1].set_title("overlap")
    for axes in panels:
        axes.set_xlim(west, east)
        axes.set_ylim(south, north)
        axes.set_aspect("equal")
        axes.grid(False)
        axes.locator_params(nbins=5)
        axes.set_xlabel("east, m" if survey.georeference else "units of the scene")
    panels[0].set_ylabel("north, m" if survey.georeference else "units of the scene")
    return figure


def _draw_cameras(figure: Figure, axes: Axes, survey: Survey) -> None:
    axes.scatter(survey.ground[:, 0], survey.ground[:, 1], s=1, c="#b9bdc1", linewidths=0,
                 rasterized=True, zorder=1)
    residuals = survey.camera_residuals
    known = residuals[np.isfinite(residuals)]
    colours = matplotlib.colormaps["viridis"].with_extremes(
        bad="white" if len(known) else COLOURS[0])
    dots = axes.scatter(survey.cameras[:, 0], survey.cameras[:, 1], c=residuals, cmap=colours,
                        vmin=0, vmax=max(known, default=1.0), plotnonfinite=True, linewidths=0.4,
                        s=float(np.clip(2000 / len(residuals), 3, 34)), edgecolors="#1d1f21",
                        zorder=3)
    axes.set_title("cameras, by their residual" if len(known) else "cameras")
    if len(known):
        figure.colorbar(dots, ax=axes, label="distance from the GPS, m", shrink=0.8)
    crossed = np.isin(survey.names, survey.left_out)
    if crossed.any():
        axes.plot(*survey.cameras[crossed].T, "x", color=COLOURS[1], markersize=8,
                  markeredgewidth=2, label="GPS left out", zorder=4)
        axes.legend(loc="upper left", frameon=True, framealpha=0.9)


def _is_curve(line: Curve) -> bool:
    """Whether the points of a curve differ in x."""
    return len(set(line[0])) > 1


def _stacked(height: float, ratios: Sequence[float], label: str) -> tuple[Figure, Any]:
    """A figure and its panels, one below the other."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    panels = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios)
    panels[-1].set_xlabel(label)
    return figure, panels


def _count_axis(axes: Axes) -> None:
    axes.yaxis.set_major_formatter(EngFormatter(sep=" "))
    axes.set_ylim(bottom=0)


def _legend_above(figure: Figure, axes: Axes, columns: int) -> None:
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=columns)


def _mark_upheavals(axes: Axes, records: Sequence[Record]) -> None:
    """Draw a line at each change of the level, and a mark at the bottom for each round of growth
    and each reset of opacities."""
    times: dict[str, list[float]] = {event: [] for event in UPHEAVALS}
    for record in records:
        if is_upheaval(record) and record.get("train_seconds") is not None:
            times[record["event"]].append(record["train_seconds"])
    for number, time in enumerate(times["level"]):
        axes.axvline(time, label="" if number else "larger photos begin", **CHANGE)
    for event, marker, label in (("grow", "|", "gaussians added"),
                                 ("reset", "v", "opacities lowered")):
        if times[event]:
            axes.plot(times[event], [0.02] * len(times[event]), marker, label=label, markersize=6,
                      color=LABEL_COLOUR, transform=axes.get_xaxis_transform(), clip_on=False)
