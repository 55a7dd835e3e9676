"""A model as the parts of its page: quantised to bytes, and compressed.

A large model is written in cells. Before them comes a coarse model, in which the gaussians of each
cell are merged to a few; a page shows that first, and in place of cells for which it has no memory.
"""

import os
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.edit.decimate import decimated
from clsplat.edit.select import merged, parted, selected, used_sh_degree
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.models.values import colours_of, morton_order, opacities, smallest_three

POSITION_STEPS = 2**24 - 1  # three bytes
USUAL = 0.9  # share of the gaussians on each axis whose distance from the middle is the unit
TURN_STEPS = 2**10 - 1  # of each of three components of a quaternion
OUTLIERS = 1e-3  # share of colours and harmonics at each end, and of smallest scales, clipped
HARMONIC_STEP = 8  # of 256: so the harmonics have 32 levels; fewer compress better, and 16 are seen
COMPRESSION = 6  # level of zlib; 9 takes twice as long for 1 % less
WHOLE = 500_000  # gaussians, up to which a model is one cell
CELL, COARSE = 131_072, 200_000  # gaussians of a cell, and of a coarse model, at most
COARSE_SHARE = 1 / 8  # of the gaussians that a coarse model has at most
Progress = Callable[[str, int, int], object]


def encoded(gaussians: Gaussians, progress: Progress = lambda *_: None) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Quantise and compress a model.

    Parameters
    ----------
    gaussians : the model; gaussians with a value that is not finite are left out.
    progress : called with a word, and how many of those are done and there are.

    Returns
    -------
    For web/unpack.js the names and bytes of the parts, in the order in which a page needs them: raw
    deflate of planes of bytes, one after the other, in each of which a gaussian has a byte. And
    the numbers that turn bytes into values, with the record of each cell.
    """
    model = gaussians.with_sh_degree(used_sh_degree(gaussians)).without_spheres()
    model = selected(
        model,
        np.all([np.isfinite(values.reshape(model.count, -1)).all(axis=1) for values in model.rows.values()], axis=0),
    )
    model = selected(model, morton_order(model.positions))
    rows = _cells(model)
    few = _coarse(model, rows, progress) if len(rows) > 1 else []
    planes, coding = _planes(merged([*few, *(selected(model, each) for each in rows)]))
    cells = [
        {
            "count": len(each),
            "coarse": few[number].count if few else 0,
            "centre": np.median(model.positions[each], axis=0).tolist(),
        }
        for number, each in enumerate(rows)
    ]
    counts = {
        "coarse": sum(each.count for each in few),
        **{f"cell{number}": len(each) for number, each in enumerate(rows)},
    }
    ends = np.cumsum([0, *counts.values()]).tolist()
    parts = {name: _compressed(planes, first, end) for name, first, end in zip(counts, ends, ends[1:]) if end > first}
    return parts, {"count": model.count, "cells": cells, **coding}


def _cells(model: Gaussians) -> list[NDArray[np.intp]]:
    """The rows of each cell, in their order; all cells have as many, to one."""
    rows = np.arange(model.count)
    rounds = 0 if model.count <= WHOLE else int(np.ceil(np.log2(model.count / CELL)))
    return parted(model.positions, rows, CELL, rounds)


def _coarse(model: Gaussians, cells: list[NDArray[np.intp]], progress: Progress) -> list[Gaussians]:
    """The few gaussians to which those of each cell are merged."""
    share, threads = min(COARSE / model.count, COARSE_SHARE), os.cpu_count() or 1
    result: list[Gaussians] = []
    for few in called_ahead(
        lambda rows: decimated(selected(model, rows), round(share * len(rows))), zip(cells), threads, threads
    ):
        result.append(few)
        progress("cell", len(result), len(cells))
    return result


def _compressed(planes: list[NDArray[np.uint8]], first: int, end: int) -> bytes:
    """Raw deflate of some columns of the planes."""
    compressor = zlib.compressobj(COMPRESSION, zlib.DEFLATED, -15)
    return b"".join([*(compressor.compress(plane[first:end].tobytes()) for plane in planes), compressor.flush()])


def _planes(model: Gaussians) -> tuple[list[NDArray[np.uint8]], dict[str, Any]]:
    """A byte of each gaussian in each plane, and the numbers that turn them into values."""
    places, position_coding = _places(model.positions)
    # a gaussian that has all but vanished may be a little larger
    least = np.quantile(model.log_scales, OUTLIERS, axis=0, method="higher")
    scales, scale_low, scale_size = _steps(np.maximum(model.log_scales, least), 255)
    colours, colour_low, colour_size = _steps(colours_of(model.sh_constant), 255, OUTLIERS)
    opacity = np.rint(255 * opacities(model))
    harmonics, reaches = _harmonics(model.sh_rest, model.sh_degree)
    turns = _turns(model.quaternions)
    planes = [places[:, axis] >> shift & 255 for shift in (16, 8, 0) for axis in range(3)]
    planes += [*scales.T, *colours.T, opacity]
    planes += [turns >> shift & 255 for shift in (0, 8, 16, 24)]
    planes += [*harmonics.T]
    return [plane.astype(np.uint8) for plane in planes], {
        "degree": model.sh_degree,
        "positions": position_coding,
        "logScales": [scale_low.tolist(), scale_size.tolist()],
        "colours": [colour_low.tolist(), colour_size.tolist()],
        "harmonics": reaches,
    }


def _places(positions: NDArray[np.float32]) -> tuple[NDArray[np.int64], list[list[float]]]:
    """Quantise positions: (int64[N, 3] in 0 ... POSITION_STEPS; middle, unit, low and size [3] each
    of middle + unit sinh(low + size * share)).

    Steps are about even within the unit and grow with the distance beyond it, so that a gaussian
    far away costs the others no precision.
    """
    middle = np.median(positions, axis=0).astype(np.float64)
    away = positions - middle
    unit = np.quantile(np.abs(away), USUAL, axis=0)
    unit = np.where(unit > 0, unit, 1.0)
    whole, low, size = _steps(np.arcsinh(away / unit), POSITION_STEPS)
    return whole, [numbers.tolist() for numbers in (middle, unit, low, size)]


def _steps(
    values: NDArray[np.floating], steps: int, clipped: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Quantise the columns of [N, 3]: (int64[N, 3] in 0 ... steps, the value of 0, and the
    difference of the value of `steps` to it)."""
    low = np.quantile(values, clipped, axis=0).astype(np.float64)
    size = np.quantile(values, 1 - clipped, axis=0) - low
    size = np.where(size > 0, size, 1.0)
    whole = np.rint(np.clip((values - low) / size, 0, 1) * steps).astype(np.int64)
    return whole, low, size


def _turns(quaternions: NDArray[np.float32]) -> NDArray[np.int64]:
    """Unit quaternions wxyz in 32 bits: which component is largest, in the 2 highest, and the other
    three in their order, 10 bits each from the lowest, -1 to 1 over sqrt(2)."""
    largest, others = smallest_three(quaternions)
    first, second, third = np.rint((others / np.sqrt(2) + 0.5) * TURN_STEPS).astype(np.int64).T
    words: NDArray[np.int64] = first | second << 10 | third << 20 | largest << 30
    return words


def _harmonics(rest: NDArray[np.float32], degree: int) -> tuple[NDArray[np.int64], list[float]]:
    """Harmonics above the constant as bytes int64[N, 3 bands], 128 for zero, and the value of 127
    steps above it for each degree."""
    bands = [rest[:, (l * l - 1) : (l * l + 2 * l)] for l in range(1, degree + 1)]  # noqa: E741
    reaches, columns = [], [np.zeros((len(rest), 0), np.int64)]
    most = 127 // HARMONIC_STEP
    for values in bands:
        reach = float(np.quantile(np.abs(values), 1 - OUTLIERS)) or 1.0
        whole = np.rint(np.clip(values / reach, -1, 1) * most) * HARMONIC_STEP
        columns.append(whole.astype(np.int64).reshape(len(rest), -1) + 128)
        reaches.append(reach * 127 / (most * HARMONIC_STEP))
    return np.concatenate(columns, axis=1), reaches
