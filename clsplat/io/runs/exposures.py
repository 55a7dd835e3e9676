"""Learned responses of views as JSON: `exposures.json` of a run or a block."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.io.records import write_object
from clsplat.io.runs.view_numbers import read_view_numbers
from clsplat.response import Response

EXPOSURES = "exposures.json"
TRANSFORM = 12
COUNTS = TRANSFORM, TRANSFORM + 4  # numbers of a view: without or with vignetting


def write_exposures(path: Path, responses: Mapping[str, Response]) -> None:
    """Write the responses of views by name, without rounding.

    A view has twelve numbers, the rows [M | t] of its transform, and the four of its vignetting
    where it has any.
    """
    write_object(path, {name: _numbers(response) for name, response in responses.items()}, indent=0)


def _numbers(response: Response) -> list[float]:
    numbers: list[float] = response.transform.ravel().tolist()
    return numbers + (response.vignetting.tolist() if response.has_vignetting else [])


def read_exposures(path: Path) -> dict[str, Response]:
    """Read what `write_exposures` wrote; InputError if it is damaged."""
    return {name: _response(row)
            for name, row in read_view_numbers(path, COUNTS, "exposures").items()}


def _response(row: NDArray[np.float64]) -> Response:
    transform, lens = row[:TRANSFORM].reshape(3, 4), row[TRANSFORM:]
    return Response(transform, lens) if len(lens) else Response(transform)
