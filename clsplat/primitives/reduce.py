"""Sums in a fixed order (cl/reduce.cl)."""

import math

from clsplat.device import Array, Device, Kernel, each, groups

SUM_COLUMNS = Kernel(
    "reduce.cl",
    "sum_columns",
    groups("width", "SCAN_GROUP"),
    count="uint",
    width="uint",
    rows=("real", "N", "W"),
    totals=("real", "W"),
)
ADD = Kernel("reduce.cl", "add_to", each("count"), count="uint", values=("real", "N"), totals=("real", "N"))


def sum_columns(device: Device, rows: Array) -> Array:
    """Sums real[W] of the columns of real[N, W], bitwise the same every time."""
    count, width = rows.shape
    totals = device.result(width)
    device.launch(SUM_COLUMNS, count=count, width=width, rows=rows, totals=totals)
    return totals


def add_to(device: Device, totals: Array, values: Array) -> None:
    """Add `values` to `totals` in place; both are real and of the same shape."""
    count = math.prod(totals.shape)
    device.launch(ADD, count=count, values=values.reshaped(count), totals=totals.reshaped(count))
