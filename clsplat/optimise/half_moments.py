"""Moments in 16 bits each on the host, as cl/include/moments.h has them on the device."""

import numpy as np
from numpy.typing import NDArray

SHIFT = 13  # bits of a float's mantissa that are dropped
BASE = 73 << 10  # of the exponent -54
MOST_RATIO = 60000.0
Codes = NDArray[np.uint16]


def decoded(ratios: Codes, roots: Codes) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The moments (m, v), of the shape of the codes of m / sqrt(v) and of sqrt(v)."""
    root = _root(roots)
    return ratios.view(np.float16).astype(np.float32) * root, root * root


def encoded(m: NDArray[np.floating], v: NDArray[np.floating], width: int) -> tuple[Codes, Codes]:
    """The codes of m / sqrt(v) and of sqrt(v), rounded to nearest.

    Moments that `decoded` returned become the codes that they were.

    Parameters
    ----------
    m, v : [N, W]
    width : of the rows of codes, at least W; the rest is 0.
    """
    bits = np.sqrt(v).astype(np.float32).view(np.uint32).astype(np.int64) + (1 << SHIFT - 1)
    roots = np.clip((bits >> SHIFT) - BASE, 0, 0xFFFF).astype(np.uint16)
    ratios = np.divide(m, _root(roots), out=np.zeros(m.shape), where=roots > 0)
    halves = np.clip(ratios, -MOST_RATIO, MOST_RATIO).astype(np.float16).view(np.uint16)
    rest = ((0, 0), (0, width - m.shape[1]))
    return np.pad(halves, rest), np.pad(roots, rest)


def _root(codes: Codes) -> NDArray[np.float32]:
    bits = (codes.astype(np.uint32) + np.uint32(BASE)) << np.uint32(SHIFT)
    return np.where(codes > 0, bits.view(np.float32), np.float32(0))
