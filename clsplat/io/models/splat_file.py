"""Gaussians as .splat, the format of antimatter15's viewer: 32 bytes a gaussian, no harmonics."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.models.quantise import unit
from clsplat.io.models.values import (
    Notes,
    byte_logits,
    colours_of,
    doubles,
    gaussians_of,
    log_scales_of,
    opacities,
    reading,
    scales_of,
    stored_positions,
    to_bytes,
)
from clsplat.io.regular import read_regular

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 3),
                ("opacity", "u1"), ("quaternion", "u1", 4)])


def write_splat(path: Path, gaussians: Gaussians, notes: Notes) -> None:
    """Write gaussians as .splat, large and opaque ones first; see `models.write_model`.

    The format has no place for comments, for spherical harmonics above the constant, or for an
    origin: coordinates that single precision does not hold are refused.
    """
    positions, origin = stored_positions(gaussians)
    if origin.any():
        raise InputError(f"{path}: .splat holds coordinates in single precision, and these are too "
                         "far from the origin for it; write .sog, .spz or .ply")
    opacity = opacities(gaussians)
    order = np.argsort(-np.exp(gaussians.log_scales.astype(np.float64).sum(axis=1)) * opacity,
                       kind="stable")
    rows = doubles(gaussians, order)
    table = np.zeros(gaussians.count, ROW)
    table["position"] = positions[order]
    table["scale"] = scales_of(rows["log_scales"])
    table["colour"] = to_bytes(255 * colours_of(rows["sh_constant"]))
    table["opacity"] = to_bytes(255 * opacity[order])
    table["quaternion"] = to_bytes(unit(rows["quaternions"]) * 128 + 128)
    with replacing(path) as file:
        file.write(table.tobytes())


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
