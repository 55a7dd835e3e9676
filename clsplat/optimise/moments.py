"""How Adam's moments are stored on a device, and what arrays of them mean (cl/include/moments.h).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

Floats = NDArray[np.floating]
SECOND_SHIFT, SECOND_BASE = 22, 33  # as in the header


class Stored(NamedTuple):
    """A way to store moments.

    Attributes
    ----------
    dtype : of the arrays on the device; None is its real type.
    values : arrays of that type -> floats.
    codes : floats -> an array of that type, the nearest code of each.
    """

    dtype: DTypeLike | None
    values: Callable[[NDArray[np.generic]], Floats]
    codes: Callable[[Floats], NDArray[np.generic]]


def first_values(codes: NDArray[np.generic]) -> Floats:
    """The values float32 of codes uint16 of m."""
    return (codes.astype(np.uint32) << np.uint32(16)).view(np.float32)


def first_codes(values: Floats) -> NDArray[np.generic]:
    """The nearest codes uint16 of values of m."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << 15)) >> np.uint32(16)).astype(np.uint16)


def second_values(codes: NDArray[np.generic]) -> Floats:
    """The values float32 of codes uint8 of v."""
    bits = (codes.astype(np.uint32) + np.uint32(SECOND_BASE)) << np.uint32(SECOND_SHIFT)
    return np.where(codes == 0, np.float32(0), bits.view(np.float32))


def second_codes(values: Floats) -> NDArray[np.generic]:
    """The nearest codes uint8 of values of v."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    codes = (bits + np.uint32(1 << SECOND_SHIFT - 1)) >> np.uint32(SECOND_SHIFT)
    codes = np.clip(codes, SECOND_BASE + 1, SECOND_BASE + 255) - SECOND_BASE
    return np.where(bits == 0, 0, codes).astype(np.uint8)


AS_REALS = Stored(None, lambda codes: codes, lambda values: values)  # type: ignore[arg-type, return-value]
FIRST_CODED = Stored(np.uint16, first_values, first_codes)
SECOND_CODED = Stored(np.uint8, second_values, second_codes)
