"""JSON files with a few numbers for each view, by its name."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.records import LARGEST_NUMBER, object_of
from clsplat.io.regular import read_regular


def read_view_numbers(path: Path, counts: Sequence[int], what: str
                      ) -> dict[str, NDArray[np.float64]]:
    """Name of a view -> its numbers; InputError if the file is damaged.

    Parameters
    ----------
    path : of the file.
    counts : how many numbers a view may have.
    what : the file's contents, for the message.
    """
    try:
        return {name: _row(name, numbers, counts)
                for name, numbers in object_of(read_regular(path)).items()}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a file of {what}, or damaged ({reason(error)}); copy it "
                         "again, or train the run that wrote it again") from None


def _row(name: str, numbers: Any, counts: Sequence[int]) -> NDArray[np.float64]:
    if not (isinstance(numbers, list) and len(numbers) in counts
            and all(type(number) in (int, float) and abs(number) < LARGEST_NUMBER
                    for number in numbers)):
        *others, last = map(str, counts)
        raise ValueError(f"{name[:80]!r} does not have "
                         f"{', '.join(others) + ' or ' if others else ''}{last} numbers")
    return np.array(numbers, np.float64)
