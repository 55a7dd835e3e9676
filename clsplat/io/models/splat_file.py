"""Reads .splat, the format of antimatter15's viewer: 32 bytes a gaussian, no harmonics."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.gaussians import Gaussians
from clsplat.io.fields import reading
from clsplat.io.models.quantise import unit
from clsplat.io.models.values import (
    Notes,
    Steps,
    byte_logits,
    gaussians_of,
    log_scales_of,
)
from clsplat.io.regular import read_regular

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 3),
                ("opacity", "u1"), ("quaternion", "u1", 4)])
COLOURS, COMPONENTS = Steps(255 * SH_C0, 127.5), Steps(128, 128)


def read_splat(path: Path, offset: NDArray[np.float64] | None = None) -> tuple[Gaussians, Notes]:
    """Read a .splat file; see `models.read_with_notes`."""
    with reading(path, "a .splat file"):
        data = read_regular(path)
        if len(data) % ROW.itemsize:
            raise ValueError(f"its {len(data)} bytes are no multiple of {ROW.itemsize}")
        table = np.frombuffer(data, ROW)
        if not (table["scale"] >= 0).all():
            raise ValueError("a scale is negative or not a number")
        return gaussians_of(path, {
            "positions": table["position"].astype(np.float64),
            "sh_constant": COLOURS.values(table["colour"]),
            "sh_rest": np.zeros((len(table), 0, 3)),
            "opacity_logits": byte_logits(table["opacity"]),
            "log_scales": log_scales_of(table["scale"].astype(np.float64)),
            "quaternions": unit(COMPONENTS.values(table["quaternion"])),
        }, np.zeros(3), offset), Notes()
