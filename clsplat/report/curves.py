"""Numbers from the records of a run: curves, crossings, means over seeds.

A curve is a straight line between two of its points; outside of them nothing is known.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Record = dict[str, Any]  # a line of metrics.jsonl
Curve = tuple[NDArray[np.float64], NDArray[np.float64]]  # x and y, [N] each, in the records' order


def curve(records: Iterable[Record], x: str, y: str, event: str | None = None) -> Curve:
    """The curve of two keys over the records of one event, or of all, that have both keys."""
    points = [(record.get(x), record.get(y)) for record in records
              if event is None or record.get("event") == event]
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
    """The x at which a curve first has y >= level, or None if it never has.

    The flag says that already the first point has it, so that x is only an upper bound.
    """
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
    nothing = (np.zeros(0),) * 4
    if not curves:
        return nothing
    start, end = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    if start > end:
        return nothing
    places = np.unique(np.concatenate([[start, end], *(x for x, _ in curves)]))
    places = places[(places >= start) & (places <= end)]
    values = np.array([np.interp(places, *line) for line in curves])
    return places, values.mean(axis=0), values.min(axis=0), values.max(axis=0)


def spread(values: Iterable[float | None]) -> tuple[float | None, float | None]:
    """The mean and the sample standard deviation of the values that are not None.

    Each is None where there are too few values.
    """
    known = [value for value in values if value is not None]
    return (float(np.mean(known)) if known else None,
            float(np.std(known, ddof=1)) if len(known) > 1 else None)
