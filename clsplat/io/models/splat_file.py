"""Reads .splat, the format of antimatter15's viewer: 32 bytes a gaussian, no harmonics."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.gaussians import Gaussians
from clsplat.io.models.quantise import unit
from clsplat.io.models.values import (
    byte_logits,
    gaussians_of,
    log_scales_of,
    reading,
)
from clsplat.io.regular import read_regular

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 3),
                ("opacity", "u1"), ("quaternion", "u1", 4)])


def read_splat(path: Path, offset: NDArray[np.float64] | None = None) -> Gaussians:
    """Read the gaussians of a .splat file; see `models.read_model`."""
    with reading(path, "a .splat file"):
        data = read_regular(path)
        if len(data) % ROW.itemsize:
            raise ValueError(f"its {len(data)} bytes are no multiple of {ROW.itemsize}")
        table = np.frombuffer(data, ROW)
        scales = table["scale"].astype(np.float64)
        if not (scales >= 0).all():
            raise ValueError("a scale is negative or not a number")
        rows = {
            "positions": table["position"].astype(np.float64),
            "sh_constant": (table["colour"] / 255 - 0.5) / SH_C0,
            "sh_rest": np.zeros((len(table), 0, 3)),
            "opacity_logits": byte_logits(table["opacity"]),
            "log_scales": log_scales_of(scales),
            "quaternions": unit((table["quaternion"] - 128.0) / 128),
        }
        return gaussians_of(path, rows, np.zeros(3), offset)
