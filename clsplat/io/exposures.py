"""Learned colour transforms of views as JSON: `exposures.json` of a run or a block."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.records import object_of, write_object
from clsplat.io.regular import read_regular

EXPOSURES = "exposures.json"


def write_exposures(path: Path, exposures: Mapping[str, ArrayLike]) -> None:
    """Write name -> float[3, 4], rows [M | t] as in `loss.exposure.Exposures`, without rounding."""
    record = {name: np.asarray(rows, np.float64).ravel().tolist()
              for name, rows in exposures.items()}
    write_object(path, record, indent=0)


def read_exposures(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read what `write_exposures` wrote, name -> float64[3, 4]; InputError if it is damaged."""
    try:
        record = object_of(read_regular(path))
        for name, numbers in record.items():
            if not (isinstance(numbers, list) and len(numbers) == 12
                    and all(type(number) in (int, float) for number in numbers)):
                raise ValueError(f"{name[:80]!r} does not have 12 numbers")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a file of exposures, or damaged ({reason(error)}); copy it "
                         "again, or train the run that wrote it again") from None
    return {name: np.array(numbers, np.float64).reshape(3, 4) for name, numbers in record.items()}
