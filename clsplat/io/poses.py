"""Learned corrections of poses as JSON: `poses.json` of a run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.records import object_of, write_object
from clsplat.io.regular import read_regular
from clsplat.placement.corrections import Correction

POSES = "poses.json"
NUMBERS = 6  # of a view: its turn, and its shift
LARGEST = 1e100


def write_poses(run: Path, corrections: Mapping[str, Correction]) -> None:
    """Write the corrections of views by name, without rounding: six numbers each, the turn and the
    shift in world units. `run` is the folder."""
    write_object(run / POSES, {name: [*each.turn.tolist(), *each.shift.tolist()]
                        for name, each in corrections.items()}, indent=0)


def read_poses(run: Path) -> dict[str, Correction]:
    """Read what `write_poses` wrote; InputError if it is damaged. A run without it has none."""
    path = run / POSES
    if not path.is_file():
        return {}
    try:
        return {name: _correction(name, numbers)
                for name, numbers in object_of(read_regular(path)).items()}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a file of corrected poses, or damaged ({reason(error)}); "
                         "copy it again, or train the run that wrote it again") from None


def _correction(name: str, numbers: Any) -> Correction:
    if not (isinstance(numbers, list) and len(numbers) == NUMBERS
            and all(type(number) in (int, float) and abs(number) < LARGEST for number in numbers)):
        raise ValueError(f"{name[:80]!r} does not have {NUMBERS} numbers")
    row = np.array(numbers, np.float64)
    return Correction(row[:3], row[3:])
