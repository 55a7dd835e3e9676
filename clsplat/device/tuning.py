"""Sizes of kernels, by what a device reports: rows of `tuning.json`, and of a file of the user.

A row has every size, and values that a device must report to get them. The first row that fits is
taken; those of the file that the environment variable CLSPLAT_TUNING names come before ours.
"""

import json
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

from clsplat.errors import InputError, reason

TUNING = "CLSPLAT_TUNING"
REPORTED: dict[str, Collection[Any]] = {  # by a device, and the values that there are
    "kind": ("cpu", "gpu"),
    "wave": (32, 64),
    "compute_units": range(1, 1 << 31),
    "local_bytes": range(1, 1 << 31),
}
SIZES: dict[str, Collection[int]] = {  # and the values for which kernels are written
    # work-items a core of the item form's FOR_EACH, as cores are not equally busy
    "item_runs": (1, 2, 4, 8, 16),
    # work-items a group of the group form's FOR_EACH, at most MOST_ITEMS of adam.cl
    "group_size": (32, 64, 128, 256),
    # work-items a group that scans or sums, a power of two, at most LANES
    "scan_group": (64, 128, 256),
    "tile": (8, 16),  # pixels, the width and height of a tile of the group form
    "bucket": (32, 64, 128),  # pairs for which one group of the blend adjoint works
    "adjoint_waves": (1, 2, 4),
}  # waves of that group
CURE = f"write it with `clsplat bench tune`, or unset {TUNING}"


def tuning_of(kind: str, wave: int, compute_units: int = 0, local_bytes: int = 0) -> dict[str, int]:
    """SIZES of the kernels of a device; InputError if the user's file cannot be used.

    Parameters
    ----------
    kind : "cpu" or "gpu".
    wave : lanes that run in step.
    compute_units : cores, or what a GPU has of them; 0: unknown.
    local_bytes : local memory of a group; 0: unknown.
    """
    reported = {"kind": kind, "wave": wave, "compute_units": compute_units, "local_bytes": local_bytes}
    ours = read_rows(Path(__file__).with_suffix(".json"))
    row = next(
        row for row in (*user_rows(), *ours) if all(row.get(name, value) == value for name, value in reported.items())
    )
    return {name: row[name] for name in SIZES}


def user_rows() -> list[dict[str, Any]]:
    """The rows of the file that CLSPLAT_TUNING names, if it names one."""
    path = os.environ.get(TUNING)
    return read_rows(Path(path)) if path else []


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a file, all of which are legal; InputError names the first fault."""
    try:
        table = json.loads(path.read_text("utf-8"))
        rows = table["rows"]
        faults = [f"row {number} {fault}" for number, row in enumerate(rows, 1) if (fault := fault_of(row))]
    except OSError as error:
        raise InputError(f"{path}: {reason(error)}; {CURE}") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path}: is not a JSON object with a list `rows`; {CURE}") from None
    if faults:
        raise InputError(f"{path}: {faults[0]}; {CURE}")
    return list(rows)


def fault_of(row: object) -> str:
    """What is wrong with a row, or ""."""
    if not isinstance(row, dict):
        return "is not an object"
    legal = {**REPORTED, **SIZES}
    for name in (*row, *SIZES):
        if name not in legal:
            return f"has the unknown key {json.dumps(name)[:40]}"
        if name not in row:
            return f"lacks {name}"
        value, values = row[name], legal[name]
        # 16.0 is in (8, 16), and True in (1, 2)
        if type(value) is not type(next(iter(values))) or value not in values:
            return f"has {name} {json.dumps(value)[:40]}, which is " + (
                "not a whole number above 0" if isinstance(values, range) else f"none of {', '.join(map(str, values))}"
            )
    return ""
