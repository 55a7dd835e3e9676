"""How Adam's moments are stored on a device, and what arrays of them mean (cl/include/moments.h)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

M_SHIFT, V_SHIFT, V_BITS = 20, 19, 4  # as in the header
Pair = tuple[NDArray[Any], NDArray[Any]]


class Stored(NamedTuple):
    """A way to store moments.

    Attributes
    ----------
    dtypes : of the two arrays on the device; None is its real type.
    moments : two arrays of these types -> m and v.
    codes : m and v -> two arrays of these types.
    """

    dtypes: tuple[DTypeLike | None, DTypeLike | None]
    moments: Callable[[NDArray[Any], NDArray[Any]], Pair]
    codes: Callable[[NDArray[Any], NDArray[Any]], Pair]


def coded_moments(first: NDArray[Any], second: NDArray[Any]) -> Pair:
    """m and v, float32, of codes uint16 and uint8."""
    first, second = first.astype(np.uint32), second.astype(np.uint32)
    m = first >> np.uint32(V_BITS) << np.uint32(M_SHIFT)
    v = (second << np.uint32(V_BITS) | first & np.uint32((1 << V_BITS) - 1)) << np.uint32(V_SHIFT)
    return m.view(np.float32), v.view(np.float32)


def moment_codes(m: NDArray[Any], v: NDArray[Any]) -> Pair:
    """The nearest codes, uint16 and uint8, of moments."""
    bits_m, bits_v = (
        (np.ascontiguousarray(values, np.float32).view(np.uint32) + np.uint32(1 << shift - 1)) >> np.uint32(shift)
        for values, shift in ((m, M_SHIFT), (v, V_SHIFT))
    )
    first = bits_m << np.uint32(V_BITS) | bits_v & np.uint32((1 << V_BITS) - 1)
    return first.astype(np.uint16), (bits_v >> np.uint32(V_BITS)).astype(np.uint8)


AS_REALS = Stored((None, None), lambda first, second: (first, second), lambda m, v: (m, v))
AS_CODES = Stored((np.uint16, np.uint8), coded_moments, moment_codes)
