"""Numbers from the records of a run: curves, means over seeds, and the scores for people.

A curve is a straight line between two of its points; outside of them nothing is known.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.report.page import Table

Record = dict[str, Any]  # a line of metrics.jsonl
Curve = tuple[NDArray[np.float64], NDArray[np.float64]]  # x and y, [N] each, in the records' order
# of the scores: key, title, format
COLUMNS = (
    ("iteration", "step", ",.0f"),
    ("train_seconds", "training, s", ",.1f"),
    ("psnr_cc", "PSNR cc, dB", ".2f"),
    ("psnr", "PSNR, dB", ".2f"),
    ("ssim_cc", "SSIM cc", ".4f"),
    ("ssim", "SSIM", ".4f"),
)
PERCEPTUAL = (
    ("flip_cc", "FLIP cc", ".4f"),
    ("flip", "FLIP", ".4f"),
    ("lpips_cc", "LPIPS cc", ".4f"),
    ("lpips", "LPIPS", ".4f"),
)  # if a run has them
GAUSSIANS = ("gaussians", "gaussians", ",.0f")
QUALITIES = ((28.0, "very good"), (25.0, "good"), (22.0, "fair"), (0.0, "poor"))  # from so many dB
EXPLAINED = (
    "As a rule of thumb for photos of real places, a PSNR from 28 dB is very good, from 25 dB good, from 22 dB fair."
)
# what lowers the scores of the next evaluation: event -> its words, and the steps until the model
# has recovered (training/budget.py has the measurement)
UPHEAVALS = {
    "reset": ("opacities just lowered", 100),
    "level": ("photos just became larger", 40),
    "grow": ("gaussians just added", 40),
}


def curve(records: Iterable[Record], x: str, y: str, event: str | None = None) -> Curve:
    """The curve of two keys over the records of one event, or of all, that have both keys."""
    points = [(record.get(x), record.get(y)) for record in records if event is None or record.get("event") == event]
    points = [point for point in points if None not in point]
    columns = np.array(points, np.float64).reshape(-1, 2).T
    return columns[0], columns[1]


def value_at(line: Curve, x_at: float) -> float | None:
    """y of a curve at x = `x_at`, or None outside of the curve."""
    x, y = line
    if not len(x) or not x[0] <= x_at <= x[-1]:
        return None
    return float(np.interp(x_at, x, y))


def reached(line: Curve, level: float) -> tuple[float, bool] | None:
    """The x at which a curve first has y >= level, and whether this is only an upper bound, as
    already the first point has it; None if it never has."""
    x, y = line
    above = np.flatnonzero(y >= level)
    if not len(above):
        return None
    after = above[0]
    if after == 0:
        return float(x[0]), True
    share = (level - y[after - 1]) / (y[after] - y[after - 1])
    return float(x[after - 1] + share * (x[after] - x[after - 1])), False


def band(curves: Sequence[Curve]) -> tuple[NDArray[np.float64], ...]:
    """The x, mean, minimum and maximum, float64[M] each, of curves where all of them are known.

    x has every point that any of the curves has there. Curves without points are left out.
    """
    curves = [line for line in curves if len(line[0])]
    start = max((x[0] for x, _ in curves), default=0.0)
    end = min((x[-1] for x, _ in curves), default=-1.0)
    if start > end:
        return (np.zeros(0),) * 4
    places = np.unique(np.concatenate([[start, end], *(x for x, _ in curves)]))
    places = places[(places >= start) & (places <= end)]
    values = np.array([np.interp(places, *line) for line in curves])
    return places, values.mean(axis=0), values.min(axis=0), values.max(axis=0)


def spread(values: Iterable[float | None]) -> tuple[float | None, float | None]:
    """The mean and the sample standard deviation of the values that are not None; each is None if
    there are too few."""
    known = [value for value in values if value is not None]
    return (float(np.mean(known)) if known else None, float(np.std(known, ddof=1)) if len(known) > 1 else None)


def main_key(record: Mapping[str, Any]) -> str:
    """The key of the PSNR to read in a record of an evaluation: after the colour fit if exposures
    were learned, as a photo that was not trained on has none, else plain."""
    return "psnr" if record.get("exposure_weight") is None else "psnr_cc"


def main_psnr(record: Mapping[str, Any]) -> float | None:
    """The PSNR to read in a record of an evaluation, dB; None: not known."""
    value: float | None = record.get(main_key(record))
    return record.get("psnr_cc") if value is None else value


def is_upheaval(record: Mapping[str, Any]) -> bool:
    """Whether what a record is about lowers the scores for a while; pruning alone does not."""
    added = (record.get("cloned") or 0) + (record.get("split") or 0)
    return record.get("event") in UPHEAVALS and (record.get("event") != "grow" or added > 0)


def disturbed(upheavals: Mapping[str, int], iteration: int) -> str:
    """Why the scores of an evaluation are lower than before; "" if nothing has happened.

    Parameters
    ----------
    upheavals : event -> step of the latest one.
    iteration : of the evaluation.
    """
    recent = [
        (at, text)
        for event, (text, steps) in UPHEAVALS.items()
        if (at := upheavals.get(event)) is not None and iteration - at <= steps
    ]
    return max(recent, key=lambda item: item[0])[1] if recent else ""


def with_quality(psnr: float | None) -> str:
    """A PSNR and its word by QUALITIES, such as "26.41 dB (good)"."""
    if psnr is None or math.isnan(psnr):
        return "unknown"
    word = next((word for least, word in QUALITIES if psnr >= least), QUALITIES[-1][1])
    return f"{psnr:.2f} dB ({word})"


def score_table(records: Sequence[Record]) -> Table | None:
    """A row for each evaluation; None without any."""
    evaluations = [record for record in records if record.get("event") == "eval"]
    columns = [
        *COLUMNS,
        *(column for column in PERCEPTUAL if any(record.get(column[0]) is not None for record in evaluations)),
        GAUSSIANS,
    ]
    rows = [tuple(number(record, key, form) for key, _, form in columns) for record in evaluations]
    note = (
        f"Means over the held-out views; cc: after a quadratic fit of each render's colours to its photo. {EXPLAINED}"
    )
    if len(columns) > len(COLUMNS) + 1:
        note += " FLIP and LPIPS, lower is better, are close to what people see; `clsplat eval` computes them."
    return Table("", tuple(title for _, title, _ in columns), rows, range(len(columns)), (note,)) if rows else None


def number(record: Mapping[str, Any], key: str, form: str) -> str:
    """A number of a record as text; "-" if it has none."""
    return "-" if record.get(key) is None else format(record[key], form)
