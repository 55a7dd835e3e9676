"""Learned responses of views as JSON: `exposures.json` of a run or a block."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.records import object_of, write_object
from clsplat.io.regular import read_regular
from clsplat.response import Response

EXPOSURES = "exposures.json"
TRANSFORM, VIGNETTING, TONE = 12, 4, 2  # numbers of a view; the last ones may be missing
COUNTS = tuple(np.cumsum((TRANSFORM, VIGNETTING, TONE)).tolist())


def write_exposures(path: Path, responses: Mapping[str, Response]) -> None:
    """Write the responses of views by name, without rounding.

    A view has twelve numbers, the rows [M | t] of its transform; the four of its vignetting where
    it has any, or a tone curve; and the two of its tone curve where it has one.
    """
    write_object(path, {name: _numbers(response) for name, response in responses.items()}, indent=0)


def _numbers(response: Response) -> list[float]:
    numbers: list[float] = response.transform.ravel().tolist()
    if response.has_vignetting or response.has_tone:
        numbers += response.vignetting.tolist()
    return numbers + (response.tone.tolist() if response.has_tone else [])


def read_exposures(path: Path) -> dict[str, Response]:
    """Read what `write_exposures` wrote; InputError if it is damaged."""
    try:
        return {name: _response(name, numbers)
                for name, numbers in object_of(read_regular(path)).items()}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a file of exposures, or damaged ({reason(error)}); copy it "
                         "again, or train the run that wrote it again") from None


def _response(name: str, numbers: Any) -> Response:
    if not (isinstance(numbers, list) and len(numbers) in COUNTS
            and all(type(number) in (int, float) for number in numbers)):
        raise ValueError(f"{name[:80]!r} does not have {', '.join(map(str, COUNTS[:-1]))} or "
                         f"{COUNTS[-1]} numbers")
    transform, *lens = np.split(np.array(numbers, np.float64), COUNTS[:-1])
    return Response(transform.reshape(3, 4), *(part for part in lens if len(part)))
