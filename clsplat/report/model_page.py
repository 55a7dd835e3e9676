"""The page that shows a model in a browser: one HTML file that needs no network.

The gaussians are written as base64 of `encoded` parts. The scripts of web/ unpack them into
textures and draw them with WebGL 2 as our own renderer does (web/splat.vert).
"""

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.atomic import replacing
from clsplat.report.encode import Progress, encoded
from clsplat.report.page import full_name, script_json, web
from clsplat.scene import NEAR_SHARE

MIDDLE = 1 / 3  # of the picture's width and height
FREEDOM = 20.0  # degrees: so much steeper or flatter than the photos may the reader look
FARTHEST = 4.0  # first distances: so far from its centre may the reader go
GROUND = 0.05  # share of what is seen that lies lower than the ground
CLEARANCE = 0.02  # of the first distance: the reader stays so high above the ground
HEIGHTS = 0.02  # share of what is seen that is lower, or higher, than the colours of heights reach
BOUNDS = 0.01  # share of what is seen that lies beyond the sliders of the cut
LARGEST_PAGE = 2**29 - 2**20  # characters: browsers hold no longer text
PART = re.compile(r"\{\{(\w[\w.]*)\}\}\n?")  # of a template: a file of web/, or a given value


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo of which a page tells: its name, its camera, and a small JPEG of it, if there is
    one."""

    name: str
    camera: Camera
    picture: bytes = b""


def write_run_page(
    path: str | Path,
    run: Run,
    gaussians: Gaussians,
    photos: Sequence[Photo] = (),
    *,
    title: str = "",
    poster: bytes = b"",
    progress: Progress = lambda *_: None,
) -> None:
    """`write_page` of the model of a run, or a part of that, as the run's first view and options
    have it; needs nothing of its scene. The title is the name of the run if it is empty."""
    options = run.options
    write_page(
        path,
        gaussians,
        run.first_view,
        run.up,
        near=near_of(run),
        title=title or full_name(run.path, run.record),
        antialiased=options.antialiased,
        background=options.background,
        photos=photos,
        poster=poster,
        georeference=run.georeference,
        progress=progress,
    )


def near_of(run: Run) -> float:
    """Depth of the near plane of a run, original world units."""
    extent = run.record.get("extent")
    if run.options.near or not isinstance(extent, (int, float)):
        return run.options.near or run.scene().near_plane
    return NEAR_SHARE * extent


def write_page(
    path: str | Path,
    gaussians: Gaussians,
    first_view: Camera,
    up: NDArray[np.float64],
    *,
    near: float,
    title: str,
    antialiased: bool = False,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    photos: Sequence[Photo] = (),
    poster: bytes = b"",
    georeference: Georeference | None = None,
    progress: Progress = lambda *_: None,
) -> None:
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
    photos : that were taken of it, in coordinates of the first view up to their offsets.
    poster : a JPEG of the first view, which is shown until the model is; b"": none.
    georeference : of its original coordinates; None: unknown, and so is their unit.
    progress : as for `encoded`.

    Raises
    ------
    InputError : the model is empty or too large for a page, or the file cannot be written.
    """
    if not gaussians.count:
        raise InputError(f"{path}: the model holds no gaussians, so a page would show nothing")
    parts, coding = encoded(gaussians, progress)
    view = first_view.shifted(gaussians.offset - first_view.offset)
    cameras = [each.camera.shifted(gaussians.offset - each.camera.offset) for each in photos]
    record = {
        **coding,
        **view_record(view, up, gaussians.positions, cameras, place_record(georeference, gaussians.offset)),
        "near": near,
        "antialiased": antialiased,
        "background": list(background),
    }
    texts = {name: _text(part) for name, part in parts.items()}
    record["characters"] = {name: len(part) for name, part in texts.items()}
    scripts = "".join(f'<script id="{name}" type="text/plain">{part}</script>\n' for name, part in texts.items())
    shown = filled("poster.html", poster=_jpeg(poster), ratio=str(view.width / view.height))
    taken = [
        {"name": each.name, "picture": _jpeg(each.picture), **_camera_record(camera)}
        for each, camera in zip(photos, cameras)
    ]
    text = filled(
        "model.html",
        title=escape(title),
        model=script_json(record),
        gaussians=scripts,
        poster=shown if poster else "",
        photos=script_json(taken),
    )
    if len(text) > LARGEST_PAGE:
        raise InputError(
            f"{path}: a page of {gaussians.count:,} gaussians would have "
            f"{len(text) >> 20:,} MiB, more than browsers open; write fewer with "
            "`clsplat train --max-gaussians`, or another format"
        )
    with replacing(path) as file:
        file.write(text.encode("utf-8", "backslashreplace"))


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode()


def _jpeg(content: bytes) -> str:
    """A JPEG as an address; "" without content."""
    return f"data:image/jpeg;base64,{_text(content)}" if content else ""


def _camera_record(camera: Camera) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        "focal": list(camera.focal),
        "centre": list(camera.centre),
        "rotation": camera.rotation.tolist(),
        "position": camera.position.tolist(),
    }


def place_record(georeference: Georeference | None, offset: NDArray[np.float64]) -> dict[str, Any]:
    """Where the origin of a page lies, for web/tools.js: `metric` says whether coordinates are
    metres in a CRS, to the east, the north and up.

    Parameters
    ----------
    georeference : of original coordinates; None: unknown.
    offset : float64[3], the origin in original coordinates.
    """
    if georeference is None:
        return {"metric": False, "crs": "", "offset": offset.tolist()}
    return {"metric": True, "crs": georeference.crs[:60], "offset": georeference.to_map(offset).tolist()}


def view_record(
    camera: Camera,
    up: NDArray[np.float64],
    points: NDArray[np.floating],
    photos: Sequence[Camera] = (),
    place: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The first view and the limits of the reader's movement, as web/camera.js takes them.

    Parameters
    ----------
    camera : of the first view.
    up : float64[3], world; the direction that is upwards.
    points : float[N, 3], world; of what is seen. The median of those in the middle of the picture
        is how far away the centre is, around which the reader turns.
    photos : the cameras of the photos, in axes of the same directions; their pitches and that of
        the first view limit where the reader may look. Empty: unknown, the first view decides.
    place : of `place_record`; None: that of coordinates without a known origin.
    """
    pixels, depths = camera.project(points)
    size = np.array([camera.width, camera.height])
    ahead = depths > 0
    middle = ahead & (np.abs(pixels - size / 2) < size * MIDDLE / 2).all(axis=1)
    chosen = depths[middle] if middle.any() else depths[ahead] if ahead.any() else np.ones(1)
    distance, up = float(np.median(chosen)), np.asarray(up, np.float64)
    finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    finite = finite if len(finite) else camera.position[None]
    heights = finite @ up
    ground = np.quantile(heights, GROUND) + CLEARANCE * distance if len(points) else np.inf
    low, high = np.quantile(heights, (BOUNDS, 1 - BOUNDS))
    centre = np.median(finite, axis=0)
    centre += ((low + high) / 2 - centre @ up) * up
    away = np.linalg.norm(np.cross(finite - centre, up), axis=1)
    slopes = np.array([each.rotation[2] @ up for each in (camera, *photos)])
    pitches = np.degrees(np.arcsin(np.clip(slopes, -1, 1)))
    return {
        **_camera_record(camera),
        "up": up.tolist(),
        "distance": distance,
        "place": place or place_record(None, np.zeros(3)),
        "heights": np.quantile(heights, (HEIGHTS, 1 - HEIGHTS)).tolist(),
        "bounds": {
            "middle": centre.tolist(),
            "height": float(high - low) / 2,
            "radius": float(np.quantile(away, 1 - BOUNDS)),
        },
        "middle": (camera.position + distance * camera.rotation[2]).tolist(),
        "reach": FARTHEST * distance,
        "ground": float(min(ground, camera.position @ up)),
        "pitches": np.radians([max(-90, pitches.min() - FREEDOM), min(90, pitches.max() + FREEDOM)]).tolist(),
    }


def filled(template: str, **values: str) -> str:
    """A file of web/ in which each {{name}} is replaced by a value, or by the file of that name."""

    def part(match: re.Match[str]) -> str:
        name = match[1]
        return values[name] if name in values else filled(name)

    return PART.sub(part, web(template))
