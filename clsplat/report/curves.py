"""Numbers from the records of a run: curves, crossings, means over seeds.

A curve is a pair (x, y) of float64[N], in the order of the records; between two of its points it is
a straight line, outside of them nothing is known.
"""

import numpy as np


def curve(records, x, y, event=None):
    """The curve of two keys over the records of one event (None: all) that have both."""
    points = [(record.get(x), record.get(y)) for record in records
              if event is None or record.get("event") == event]
    points = [point for point in points if None not in point]
    return tuple(np.array(points, np.float64).reshape(-1, 2).T)


def frequency_curves(records):
    """{variant: {axis: curve over iterations}} of the scene frequencies in the step records."""
    samples = [{**(record.get("frequency") or {}), "iteration": record.get("iteration")}
               for record in records if record.get("event") == "step"]
    names = {name: None for sample in samples for name in sample if name != "iteration"}
    found = {}
    for name in names:
        x, y = curve(samples, "iteration", name)
        if len(x):
            variant, _, axis = name.rpartition("_")
            found.setdefault(variant, {})[axis] = x, y
    return found


def value_at(line, when):
    """y of a curve at x = `when`, or None outside of it."""
    x, y = line
    if not len(x) or not x[0] <= when <= x[-1]:
        return None
    return float(np.interp(when, x, y))


def reached(line, level):
    """Where a curve first has y >= level: (x, False); (x, True) where its first point has, so that
    x is only an upper bound; None where it never has."""
    x, y = line
    above = np.flatnonzero(y >= level)
    if not len(above):
        return None
    after = above[0]
    if after == 0:
        return float(x[0]), True
    share = (level - y[after - 1]) / (y[after] - y[after - 1])
    return float(x[after - 1] + share * (x[after] - x[after - 1])), False


def band(curves):
    """(x, mean, low, high), float64[M] each, of curves over the range of x that all of them have.

    x are the places where any of them has a point. Curves without points are left out.
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


def spread(values):
    """(mean, sample standard deviation) of those that are not None; None where too few are."""
    values = [value for value in values if value is not None]
    return (float(np.mean(values)) if values else None,
            float(np.std(values, ddof=1)) if len(values) > 1 else None)
