"""The page that shows a model in a browser: one HTML file that needs no network.

The gaussians are quantised to bytes, compressed and written as base64. The scripts of web/ unpack
them into textures and draw them with WebGL 2 as our own renderer does (web/splat.vert).
"""

import base64
import re
import zlib
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.edit.select import selected, used_sh_degree
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.models.values import colours_of, morton_order, opacities, smallest_three
from clsplat.report.page import full_name, script_json, web
from clsplat.scene import NEAR_SHARE

POSITION_STEPS = 2**24 - 1  # three bytes
USUAL = 0.9  # share of the gaussians on each axis whose distance from the middle is the unit
TURN_STEPS = 2**10 - 1  # of each of three components of a quaternion
MIDDLE = 1 / 3  # of the picture's width and height
OUTLIERS = 1e-3  # share of colours and harmonics at each end, and of smallest scales, clipped
HARMONIC_STEP = 8  # of 256: so the harmonics have 32 levels; fewer compress better, and 16 are seen
COMPRESSION = 6  # level of zlib; 9 takes twice as long for 1 % less
FREEDOM = 20.0  # degrees: so much steeper or flatter than the photos may the reader look
FARTHEST = 4.0  # first distances: so far from its centre may the reader go
GROUND = 0.05  # share of what is seen that lies lower than the ground
CLEARANCE = 0.02  # of the first distance: the reader stays so high above the ground
LARGEST_PAGE = 2**29 - 2**20  # characters: browsers hold no longer text
PART = re.compile(r"\{\{(\w[\w.]*)\}\}\n?")  # of a template: a file of web/, or a given value


def write_run_page(path: str | Path, run: Run, gaussians: Gaussians,
                   photos: Sequence[Camera] = ()) -> None:
    """`write_page` of the model of a run, or a part of that, as the run's first view and options
    have it; needs nothing of its scene."""
    options = run.options
    write_page(path, gaussians, run.first_view, run.up, near=near_of(run),
               title=full_name(run.path, run.record), antialiased=options.antialiased,
               background=options.background, photos=photos)


def near_of(run: Run) -> float:
    """Depth of the near plane of a run, original world units."""
    extent = run.record.get("extent")
    if run.options.near or not isinstance(extent, (int, float)):
        return run.options.near or run.scene().near_plane
    return NEAR_SHARE * extent


def write_page(path: str | Path, gaussians: Gaussians, first_view: Camera,
               up: NDArray[np.float64], *, near: float, title: str, antialiased: bool = False,
               background: Sequence[float] = (0.0, 0.0, 0.0),
               photos: Sequence[Camera] = ()) -> None:
    """Write a page that shows a model and lets the reader move through it.

    Parameters
    ----------
    path : the file, which is replaced as a whole.
    gaussians : the model.
    first_view : the camera from which the page shows it first; its world is that of the model, up
        to the offsets of both.
    up : float64[3], the direction that is upwards.
    near : depth of the near plane, world units.
    title : of the page.
    antialiased : whether the model was trained with opacities that the low-pass filter scales.
    background : red, green and blue, 0 to 1.
    photos : as for `view_record`.

    Raises
    ------
    InputError : the model is empty or too large for a page, or the file cannot be written.
    """
    if not gaussians.count:
        raise InputError(f"{path}: the model holds no gaussians, so a page would show nothing")
    content, coding = encoded(gaussians)
    view = first_view.shifted(gaussians.offset - first_view.offset)
    model = {**coding, **view_record(view, up, gaussians.positions, photos),
             "near": near, "antialiased": antialiased, "background": list(background)}
    text = filled("model.html", title=escape(title), model=script_json(model),
                  gaussians=base64.b64encode(content).decode())
    if len(text) > LARGEST_PAGE:
        raise InputError(f"{path}: a page of {gaussians.count:,} gaussians would have "
                         f"{len(text) >> 20:,} MiB, more than browsers open; write fewer with "
                         "`clsplat train --max-gaussians`, or another format")
    with replacing(path) as file:
        file.write(text.encode("utf-8", "backslashreplace"))


def view_record(camera: Camera, up: NDArray[np.float64], points: NDArray[np.floating],
                photos: Sequence[Camera] = ()) -> dict[str, Any]:
    """The first view and the limits of the reader's movement, as web/camera.js takes them.

    Parameters
    ----------
    camera : of the first view.
    up : float64[3], world; the direction that is upwards.
    points : float[N, 3], world; of what is seen. The median of those in the middle of the picture
        is how far away the centre is, around which the reader turns.
    photos : the cameras of the photos, in axes of the same directions; their pitches and that of
        the first view limit where the reader may look. Empty: unknown, the first view decides.
    """
    pixels, depths = camera.project(points)
    size = np.array([camera.width, camera.height])
    ahead = depths > 0
    middle = ahead & (np.abs(pixels - size / 2) < size * MIDDLE / 2).all(axis=1)
    chosen = depths[middle] if middle.any() else depths[ahead] if ahead.any() else np.ones(1)
    distance, up = float(np.median(chosen)), np.asarray(up, np.float64)
    heights = points[np.isfinite(points).all(axis=1)].astype(np.float64) @ up
    ground = np.quantile(heights, GROUND) + CLEARANCE * distance if len(heights) else np.inf
    slopes = np.array([each.rotation[2] @ up for each in (camera, *photos)])
    pitches = np.degrees(np.arcsin(np.clip(slopes, -1, 1)))
    return {"width": camera.width, "height": camera.height, "focal": list(camera.focal),
            "centre": list(camera.centre), "rotation": camera.rotation.tolist(),
            "position": camera.position.tolist(), "up": up.tolist(), "distance": distance,
            "middle": (camera.position + distance * camera.rotation[2]).tolist(),
            "reach": FARTHEST * distance,
            "ground": float(min(ground, camera.position @ up)),
            "pitches": np.radians([max(-90, pitches.min() - FREEDOM),
                                   min(90, pitches.max() + FREEDOM)]).tolist()}


def filled(template: str, **values: str) -> str:
    """A file of web/ in which each {{name}} is replaced by a value, or by the file of that name."""
    def part(match: re.Match[str]) -> str:
        name = match[1]
        return values[name] if name in values else filled(name)
    return PART.sub(part, web(template))


def encoded(gaussians: Gaussians) -> tuple[bytes, dict[str, Any]]:
    """Quantise and compress a model.

    Parameters
    ----------
    gaussians : the model; gaussians with a value that is not finite are left out.

    Returns
    -------
    The bytes that web/unpack.js reads: raw deflate of planes of bytes, one after the other, in
    each of which a gaussian has a byte. And the numbers that turn bytes into values.
    """
    model = gaussians.with_sh_degree(used_sh_degree(gaussians))
    model = selected(model, np.all([np.isfinite(values.reshape(model.count, -1)).all(axis=1)
                                    for values in model.rows.values()], axis=0))
    model = selected(model, morton_order(model.positions))
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
    compressor = zlib.compressobj(COMPRESSION, zlib.DEFLATED, -15)
    content = b"".join(compressor.compress(plane.astype(np.uint8).tobytes()) for plane in planes)
    return content + compressor.flush(), {
        "count": model.count, "degree": model.sh_degree, "positions": position_coding,
        "logScales": [scale_low.tolist(), scale_size.tolist()],
        "colours": [colour_low.tolist(), colour_size.tolist()], "harmonics": reaches}


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


def _steps(values: NDArray[np.floating], steps: int, clipped: float = 0.0
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
    bands = [rest[:, (l * l - 1):(l * l + 2 * l)] for l in range(1, degree + 1)]  # noqa: E741
    reaches, columns = [], [np.zeros((len(rest), 0), np.int64)]
    most = 127 // HARMONIC_STEP
    for values in bands:
        reach = float(np.quantile(np.abs(values), 1 - OUTLIERS)) or 1.0
        whole = np.rint(np.clip(values / reach, -1, 1) * most) * HARMONIC_STEP
        columns.append(whole.astype(np.int64).reshape(len(rest), -1) + 128)
        reaches.append(reach * 127 / (most * HARMONIC_STEP))
    return np.concatenate(columns, axis=1), reaches
