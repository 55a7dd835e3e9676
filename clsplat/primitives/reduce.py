"""Sums in a fixed order (cl/reduce.cl)."""

from clsplat.device import Kernel, groups

SUM_COLUMNS = Kernel("reduce.cl", "sum_columns", groups("width", "SCAN_GROUP"), count="uint",
                     width="uint", rows=("real", "N", "W"), totals=("real", "W"))


def sum_columns(device, rows):
    """real[W]: the sums of the columns of real[N, W], bitwise the same every time."""
    count, width = rows.shape
    totals = device.empty(width)
    device.launch(SUM_COLUMNS, count=count, width=width, rows=rows, totals=totals)
    return totals
