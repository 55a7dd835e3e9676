"""Numbers of models that are not finite: some have a meaning, rows with others are left out.

Programs write +inf as the logit of an opaque gaussian, and -inf as the logarithm of a size of zero.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError

# what stands for infinity: opacities that single precision and logits can hold, and the logarithm
# of a scale whose exponential is a finite float32, as is that of its negative
LEAST_OPACITY, GREATEST_OPACITY = 1e-30, 1 - 2.0**-24
LARGEST_LOG_SCALE = 80.0
MOST_LEFT_OUT = 0.5  # of a file's rows; one with more is damaged


def with_meaning(name: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The values of a field, with finite ones in place of infinite ones that have a meaning."""
    if np.isfinite(values).all():
        return values
    if name == "opacity_logits":
        low, high = (np.log(end / (1 - end)) for end in (LEAST_OPACITY, GREATEST_OPACITY))
        values = np.where(np.isinf(values), np.where(values > 0, high, low), values)
    elif name == "log_scales":
        values = np.where(np.isneginf(values), -LARGEST_LOG_SCALE, values)
    return values.astype(np.float32)


def usable(path: str | Path, rows: dict[str, NDArray[Any]], most_left_out: float = MOST_LEFT_OUT
           ) -> dict[str, NDArray[Any]]:
    """Those rows [N, ...] of some fields whose numbers are all finite; a warning counts the others.

    Parameters
    ----------
    path : the file that messages name.
    most_left_out : of the rows, 0 to 1; 0 for a file that clsplat wrote.

    Raises
    ------
    InputError : more rows would be left out.
    """
    finite = np.logical_and.reduce([
        np.isfinite(values).all(axis=tuple(range(1, values.ndim))) for values in rows.values()])
    count, bad = len(finite), int(np.count_nonzero(~finite))
    if not bad:
        return rows
    if bad > most_left_out * count:
        name, values = next((name, values) for name, values in rows.items()
                            if not np.isfinite(values).all())
        raise InputError(f"{path}: {bad} of {count} rows hold numbers that are not finite, "
                         f"{np.count_nonzero(~np.isfinite(values))} of them in {name}; export or "
                         "copy it again")
    logging.getLogger(__name__).warning(
        "%s: %d of %d rows hold numbers that are not finite: they are left out", path, bad, count)
    return {name: values[finite] for name, values in rows.items()}
