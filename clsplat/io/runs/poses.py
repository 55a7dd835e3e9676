"""Learned corrections of poses as JSON: `poses.json` of a run."""

from collections.abc import Mapping
from pathlib import Path

from clsplat.io.records import write_object
from clsplat.io.runs.view_numbers import read_view_numbers
from clsplat.placement.corrections import Correction

POSES = "poses.json"
NUMBERS = 6  # of a view: its turn, and its shift


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
    rows = read_view_numbers(path, (NUMBERS,), "corrected poses")
    return {name: Correction(row[:3], row[3:]) for name, row in rows.items()}
