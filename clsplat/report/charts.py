"""The charts of pages as data, which web/chart.js draws with uPlot in the reader's browser.

A chart is a function that returns a Chart, or None if there is nothing to draw: `panels` with one
`x` axis, below each other, or as a `pair` beside each other, and `marks`, event of MARKS ->
[(x, text)].
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.report.page import script_json
from clsplat.report.scores import UPHEAVALS, Curve, Record, band, curve, is_upheaval
from clsplat.schedule.plan import size_at

Chart = dict[str, Any]  # what web/chart.js reads
DIGITS = 6  # of a number in a page
MARKS = {
    "level": "dashed: larger photos begin",
    "grow": "|: gaussians added",
    "reset": "▾: opacities lowered",
}  # event -> what its mark means


@dataclass(frozen=True)
class Line:
    """A curve of a panel.

    Attributes
    ----------
    label : in the legend; "" for none.
    points : x, increasing, and y.
    colour : number of its colour; lines of one name have one.
    kind : "line", "steps", "dots" (points without a line), "both", or "band".
    high : the upper edge of a band, whose lower edge is y.
    """

    label: str
    points: Curve
    colour: int = 0
    kind: str = "line"
    high: NDArray[np.float64] | None = None


def _panel(title: str, lines: Sequence[Line], scale: str = "linear", levels: Sequence[float] = ()) -> dict[str, Any]:
    """One pair of axes: the `scale` of y is "linear", "log", or "count", from 0 with k and M, and a
    line is drawn at the `levels` of y; `data` are the columns x, y, y, ... of uPlot."""
    return {
        "title": title,
        "scale": scale,
        "levels": list(levels),
        "data": _columns(lines),
        "lines": [{"label": line.label, "colour": line.colour, "kind": line.kind} for line in lines],
    }


def _columns(lines: Iterable[Line]) -> list[list[float | None]]:
    """All x of some lines, and their y (a band has two); None where a line has no point."""
    places = np.unique(np.concatenate([line.points[0] for line in lines]))
    columns = [places]
    for line in lines:
        for values in (line.points[1], line.high):
            if values is None:
                continue
            column = np.full(len(places), np.nan)
            column[np.searchsorted(places, line.points[0])] = values
            columns.append(column)
    return [[float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in column] for column in columns]


def drawn(description: str, chart: Callable[..., Chart | None], *arguments: object) -> str:
    """HTML of a chart, "" if there is nothing to draw, or a line of text after an error.

    Parameters
    ----------
    description : the text for readers who cannot see the chart.
    chart : called with the arguments.
    """
    try:
        found = chart(*arguments)
        data = script_json(found)
    except Exception as error:  # noqa: BLE001  (no chart is worth a page)
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        return f"<p class=note>{escape(description)}: could not be drawn ({escape(reason)}).</p>\n"
    if found is None:
        return ""
    marks = "; ".join(MARKS[event] for event, places in found["marks"].items() if places)
    kind = "chart pair" if found.get("pair") else "chart"
    return (
        f'<div class="{kind}" role="img" aria-label="{escape(description)}">'
        f'<script type="application/json">{data}</script></div>\n'
        + (f"<p class=note>{escape(marks)}.</p>\n" if marks else "")
    )


def comparison_chart(groups: Mapping[str, Sequence[Sequence[Record]]], levels: Sequence[float]) -> Chart | None:
    """Colour-corrected PSNR and SSIM, and the number of gaussians, over training time.

    Each group has a line at the mean of its runs, a band from the minimum to the maximum, and a dot
    at every evaluation. None if no run was evaluated twice.

    Parameters
    ----------
    groups : name -> the records of its runs.
    levels : PSNR, dB, to mark.
    """
    if not any(_is_curve(curve(run, "train_seconds", "psnr_cc", "eval")) for runs in groups.values() for run in runs):
        return None
    panels = []
    for title, key, event in (
        ("PSNR after the colour fit, dB", "psnr_cc", "eval"),
        ("SSIM after the colour fit", "ssim_cc", "eval"),
        ("gaussians", "gaussians", None),
    ):
        lines = []
        for colour, (name, runs) in enumerate(groups.items()):
            curves = [_once(curve(run, "train_seconds", key, event)) for run in runs]
            x, mean, low, high = band(curves)
            lines.append(Line(name, (x, mean), colour))
            if len(runs) > 1:
                lines.append(Line("", (x, low), colour, "band", high))
            lines += [Line("", line, colour, "dots") for line in curves if event]
        panels.append(_panel(title, lines, "linear" if event else "count", levels if key == "psnr_cc" else ()))
    return {"x": "training time, s", "panels": panels, "marks": {}}


def score_chart(records: Sequence[Record]) -> Chart | None:
    """PSNR and SSIM over training time, plain and after the colour fit, and what lowers them.

    None with fewer than two evaluations.
    """
    if not any(_is_curve(curve(records, "train_seconds", key, "eval")) for key in ("psnr", "ssim")):
        return None
    panels = [
        _panel(
            title,
            [
                Line(label, _once(curve(records, "train_seconds", key + suffix, "eval")), colour, "both")
                for colour, (suffix, label) in enumerate((("_cc", "after the colour fit"), ("", "plain")))
            ],
        )
        for key, title in (("psnr", "PSNR, dB"), ("ssim", "SSIM"))
    ]
    marks: dict[str, list[tuple[float, str]]] = {event: [] for event in UPHEAVALS}
    for record in records:
        if is_upheaval(record) and record.get("train_seconds") is not None:
            marks[record["event"]].append((record["train_seconds"], ""))
    return {"x": "training time, s", "panels": panels, "pair": True, "marks": marks}


def step_chart(records: Sequence[Record]) -> Chart | None:
    """Gaussians, loss and, if it changes, level over iterations; None without a curve."""
    gaussians, loss, level = (_once(curve(records, "iteration", key)) for key in ("gaussians", "loss", "level"))
    if not _is_curve(loss):  # a city takes no steps itself
        return None
    panels = [
        _panel("gaussians", [Line("gaussians", gaussians, kind="steps")], "count"),
        _panel("loss", [Line("loss", loss)], "log"),
    ]
    if len(set(level[1])) > 1:
        panels.append(
            _panel("level: how many times smaller the images are", [Line("level", level, kind="steps")], "count")
        )
    changes = zip(*curve(records, "iteration", "level", "level"))
    return {
        "x": "iteration",
        "panels": panels,
        "marks": {"level": [(iteration, size_at(value)) for iteration, value in changes]},
    }


def _is_curve(line: Curve) -> bool:
    """Whether the points of a curve differ in x."""
    return len(set(line[0])) > 1


def _once(line: Curve) -> Curve:
    """The curve with its x increasing, each once: the last of its points there."""
    x, from_end = np.unique(line[0][::-1], return_index=True)
    return x, line[1][::-1][from_end]
