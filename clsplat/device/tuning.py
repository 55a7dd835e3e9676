"""Sizes of kernels that suit a kind of device, from one table: `tuning.json`."""

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources


@dataclass(frozen=True)
class Tuning:
    """The sizes of the kernels of a device.

    Attributes
    ----------
    item_runs : work-items a core of the item form's FOR_EACH, as cores are not equally busy.
    group_size : work-items a group of the group form's FOR_EACH.
    scan_group : work-items a group that scans or sums, a power of two, at most LANES.
    tile : pixels, the width and height of a tile.
    bucket : pairs for which one group of the blend adjoint works, a multiple of 32.
    adjoint_waves : waves of that group.
    """

    item_runs: int
    group_size: int
    scan_group: int
    tile: int
    bucket: int
    adjoint_waves: int


@cache
def tuning_of(kind: str, wave: int) -> Tuning:
    """The row of the table for a device.

    Parameters
    ----------
    kind : "cpu" or "gpu".
    wave : lanes that run in step.
    """
    table = json.loads(resources.files(__package__).joinpath("tuning.json").read_text("utf-8"))
    row = next(row for row in table["rows"]
               if row["kind"] == kind and row.get("wave", wave) == wave)
    return Tuning(**{name: value for name, value in row.items() if name not in ("kind", "wave")})
