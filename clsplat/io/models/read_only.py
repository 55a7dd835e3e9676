"""Formats that are only read: compressed PLY and .splat.

Compressed PLY is the format of PlayCanvas and SuperSplat. Chunks of 256 gaussians record the least
and greatest of their positions, log scales and colours; each gaussian has four words of 32 bits,
relative to those, and a byte for each harmonic. A .splat, of antimatter15's viewer, has 32 bytes a
gaussian, and no harmonics.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.gaussians import Gaussians
from clsplat.io.fields import numbers, reading
from clsplat.io.models.quantise import from_smallest_three, unit
from clsplat.io.models.values import Notes, Steps, byte_logits, gaussians_of, log_scales_of
from clsplat.io.regular import read_regular

CHUNK = 256  # gaussians
# columns of a chunk: the ends of a range of positions, log scales, colours
LIMITS = tuple(f"{end}_{name}" for names in ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb")
               for end in ("min", "max") for name in names)
# the bits of the numbers in each word, the first of which has the most significant ones
WORDS = {"packed_position": (11, 10, 11), "packed_rotation": (2, 10, 10, 10),
         "packed_scale": (11, 10, 11), "packed_color": (8, 8, 8, 8)}
SH_RANGE = 8.0  # from -4 to 4
SPLAT = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 3),
                  ("opacity", "u1"), ("quaternion", "u1", 4)])
SPLAT_COLOURS, SPLAT_COMPONENTS = Steps(255 * SH_C0, 127.5), Steps(128, 128)
ORIGIN = "origin_of_positions "  # comment of earlier versions of clsplat, which wrote this format


def is_compressed(elements: Mapping[str, plyfile.PlyElement]) -> bool:
    """Whether the elements of a PLY file are those of a compressed PLY."""
    return "chunk" in elements and "vertex" in elements and (
        "packed_position" in elements["vertex"].data.dtype.names)


def compressed_gaussians(path: Path, elements: Mapping[str, plyfile.PlyElement],
                         comments: Iterable[str], offset: NDArray[np.float64] | None) -> Gaussians:
    """The gaussians of a compressed PLY that was read; see `models.read_model`."""
    with reading(path, "a compressed PLY"):
        vertices, chunks = elements["vertex"].data, elements["chunk"].data
        count = len(vertices)
        # files of older programs have no limits of colours: they are 0 and 1
        limits = np.stack([
            _column(chunks, name, "f") if name in chunks.dtype.names else
            np.full(len(chunks), float(name.startswith("max"))) for name in LIMITS], axis=1)
        if len(limits) != -(-count // CHUNK):
            raise ValueError(f"{count} gaussians do not fit {len(limits)} chunks")
        low, high = np.repeat(limits.reshape(-1, 3, 2, 3), CHUNK, axis=0)[:count].transpose(
            2, 1, 0, 3)
        position, rotation, scale, colour = (
            _unpacked(_column(vertices, name, "u"), bits) for name, bits in WORDS.items())
        shares = np.stack([position, scale, colour[:, :3]])
        positions, log_scales, colours = low * (1 - shares) + high * shares
        table = elements["sh"].data if "sh" in elements else np.zeros(count, [])
        harmonics = np.zeros((count, len(table.dtype.names or ())))
        for number in range(harmonics.shape[1]):
            harmonics[:, number] = _column(table, f"f_rest_{number}", "u")
        # the middle of a step, but the ends of the range exactly
        sh = np.where(harmonics == 255, 1, np.where(harmonics == 0, 0, (harmonics + 0.5) / 256))
        rows = {
            "positions": positions,
            "sh_constant": (colours - 0.5) / SH_C0,
            "sh_rest": ((sh - 0.5) * SH_RANGE).reshape(
                count, 3, harmonics.shape[1] // 3).transpose(0, 2, 1),
            "opacity_logits": byte_logits(np.rint(colour[:, 3] * 255).astype(np.uint8)),
            "log_scales": log_scales,
            "quaternions": from_smallest_three(np.rint(rotation[:, 0] * 3).astype(int),
                                               (rotation[:, 1:] - 0.5) * np.sqrt(2)),
        }
        origin = next((numbers(comment[len(ORIGIN):], 3, "its origin") for comment in comments
                       if comment.startswith(ORIGIN)), np.zeros(3))
        return gaussians_of(path, rows, origin, offset)


def read_splat(path: Path, offset: NDArray[np.float64] | None = None) -> tuple[Gaussians, Notes]:
    """Read a .splat file; see `models.read_with_notes`."""
    with reading(path, "a .splat file"):
        data = read_regular(path)
        if len(data) % SPLAT.itemsize:
            raise ValueError(f"its {len(data)} bytes are no multiple of {SPLAT.itemsize}")
        table = np.frombuffer(data, SPLAT)
        if not (table["scale"] >= 0).all():
            raise ValueError("a scale is negative or not a number")
        return gaussians_of(path, {
            "positions": table["position"].astype(np.float64),
            "sh_constant": SPLAT_COLOURS.values(table["colour"]),
            "sh_rest": np.zeros((len(table), 0, 3)),
            "opacity_logits": byte_logits(table["opacity"]),
            "log_scales": log_scales_of(table["scale"].astype(np.float64)),
            "quaternions": unit(SPLAT_COMPONENTS.values(table["quaternion"])),
        }, np.zeros(3), offset), Notes()


def _unpacked(words: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.float64]:
    """Numbers 0 to 1, [N, k], from words [N]."""
    places = np.cumsum((0, *bits[:0:-1]))[::-1]
    most = (1 << np.array(bits)) - 1
    return np.asarray((words.astype(np.int64)[:, None] >> places & most) / most, np.float64)


def _column(table: NDArray[Any], name: str, kind: str) -> NDArray[Any]:
    if name not in (table.dtype.names or ()) or table.dtype[name].kind != kind:
        raise ValueError(f"column {name} is missing or of another type")
    values: NDArray[Any] = table[name]
    return values
