"""Learned colour transforms by name of view, as JSON: `exposures.json` of a run, of a block."""

import numpy as np

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.records import object_of, write_object
from clsplat.io.regular import read_regular

EXPOSURES = "exposures.json"


def write_exposures(path, exposures):
    """Write name -> float[3, 4], rows [M | t] as `loss.exposure.Exposures` has them; each is kept
    to the bit."""
    record = {name: np.asarray(rows, np.float64).ravel().tolist()
              for name, rows in exposures.items()}
    write_object(path, record, indent=0)


def read_exposures(path):
    """What `write_exposures` wrote: a dict of name -> float64[3, 4]; InputError where it is not."""
    try:
        record = object_of(read_regular(path))
        for name, numbers in record.items():
            if not (isinstance(numbers, list) and len(numbers) == 12
                    and all(type(number) in (int, float) for number in numbers)):
                raise ValueError(f"{name[:80]!r} has no 12 numbers")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no exposures, or damaged ({reason(error)}); copy it again, or "
                         "train the run that wrote it again") from None
    return {name: np.array(numbers, np.float64).reshape(3, 4) for name, numbers in record.items()}
