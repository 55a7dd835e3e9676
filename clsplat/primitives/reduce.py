"""Sums in a fixed order (cl/reduce.cl)."""

from clsplat.device import Kernel

SUM_COLUMNS = Kernel("reduce.cl", "sum_columns", count="uint", width="uint",
                     rows=("real", "N", "W"), totals=("real", "W"))


def sum_columns(device, rows):
    """real[W]: the sums of the columns of real[N, W], bitwise the same every time."""
    count, width = rows.shape
    totals = device.empty(width)
    group = device.scan_group
    device.launch(SUM_COLUMNS, width * group, group, (("GROUP", group),), count=count, width=width,
                  rows=rows, totals=totals)
    return totals
