"""What a run learned of its views, by their names: JSON files with a few numbers for each."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.io.fields import numbers, reading
from clsplat.io.records import object_of, write_object
from clsplat.io.regular import read_regular
from clsplat.placement.corrections import Correction
from clsplat.response import Response

EXPOSURES, POSES = "exposures.json", "poses.json"
TRANSFORM, VIGNETTING, POSE = 12, 4, 6  # numbers of a view


def write_exposures(path: Path, responses: Mapping[str, Response]) -> None:
    """Write the responses of views by name, without rounding.

    A view has twelve numbers, the rows [M | t] of its transform, and the four of its vignetting
    where it has any.
    """
    write_object(path, {name: [*response.transform.ravel().tolist(), *(
        response.vignetting.tolist() if response.has_vignetting else [])]
        for name, response in responses.items()}, indent=0)


def read_exposures(path: Path) -> dict[str, Response] | None:
    """Read what `write_exposures` wrote, None without it; InputError if it is damaged."""
    if not path.is_file():
        return None
    rows = _read(path, (TRANSFORM, TRANSFORM + VIGNETTING), "a file of exposures")
    return {name: Response(row.reshape(3, 4)) if len(row) == TRANSFORM else
            Response(row[:TRANSFORM].reshape(3, 4), row[TRANSFORM:]) for name, row in rows.items()}


def write_poses(run: Path, corrections: Mapping[str, Correction]) -> None:
    """Write the corrections of views by name, without rounding: six numbers each, the turn and the
    shift in world units. `run` is the folder."""
    write_object(run / POSES, {name: [*each.turn.tolist(), *each.shift.tolist()]
                               for name, each in corrections.items()}, indent=0)


def read_poses(run: Path) -> dict[str, Correction]:
    """Read what `write_poses` wrote; InputError if it is damaged. A run without it has none."""
    if not (run / POSES).is_file():
        return {}
    rows = _read(run / POSES, (POSE,), "a file of corrected poses")
    return {name: Correction(row[:3], row[3:]) for name, row in rows.items()}


def _read(path: Path, counts: Sequence[int], what: str) -> dict[str, NDArray[np.float64]]:
    """The numbers of each view, of which there may be so many."""
    with reading(path, what, "copy it again, or train the run that wrote it again"):
        rows = object_of(read_regular(path))
        return {name: numbers(row, counts[-1] if len(row) != counts[0] else counts[0], name[:80])
                for name, row in rows.items()}
