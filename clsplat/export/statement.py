"""What a map says of its own exactness, in its record, the tags of its files and its last lines."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from clsplat.export.map_grid import ground_resolution
from clsplat.georeference import Georeference
from clsplat.io.georeference.crs import vertical_part
from clsplat.scene import Scene

MOST_RESIDUAL = 0.03  # of the flight
AXES = ("east", "north", "up")
ROLES = ("check", "control")  # points that were left out of the adjustment say more


def stated(scene: Scene, crs: str | None, place: Georeference | None) -> dict[str, Any]:
    """What is known of a map's exactness, for RECORD: the ground sampling distance of the photos,
    the vertical reference, and the georeference with its residuals, metres."""
    result: dict[str, Any] = {"ground_sampling_distance": ground_resolution(scene)}
    if place is None or crs is None:
        return result
    # files of older versions lack most of these
    errors = {role: {axis: error.rms for axis, error in place.errors(role).items()}
              for role in ROLES} if hasattr(place, "errors") else {}
    return {**result, "vertical_reference": getattr(place, "vertical", "") or vertical_part(
        place.crs) or "unknown",
            "georeference": {"source": place.source, "residual": place.residual,
                             "residuals_rms": {role: axes for role, axes in errors.items() if axes},
                             "warnings": _warnings(scene, place)}}


def _warnings(scene: Scene, place: Georeference) -> list[str]:
    """Those of the georeference; a file of an older version, without a size, is judged by the
    flight."""
    warnings = list(getattr(place, "warnings", ()))
    if warnings or getattr(place, "size", None) or not scene.views:
        return warnings
    flight = scene.unit * float(np.linalg.norm(np.ptp(
        [view.camera.position for view in scene.views], axis=0)))
    if place.residual <= MOST_RESIDUAL * flight:
        return []
    return [f"the residual of the georeference, {place.residual:.2f} m, is large for a flight of "
            f"{flight:.3g} m; check its source before distances and places are trusted"]


def tags_of(statement: dict[str, Any]) -> dict[str, str]:
    """The tags of a GeoTIFF, in GDAL's metadata."""
    return {"TIFFTAG_SOFTWARE": "clsplat",
            **{name.upper(): value if isinstance(value, str) else json.dumps(value)
               for name, value in statement.items()}}


def sentences(statement: dict[str, Any], unit: str) -> list[str]:
    """What `clsplat map` prints of it."""
    lines = [f"ground sampling distance of the photos {statement['ground_sampling_distance']:g} "
             f"{unit}"]
    place = statement.get("georeference")
    if place:
        lines[0] += f"; heights: {statement['vertical_reference']}"
        lines.append(f"georeference: {place['source'] or 'unknown source'}, residual "
                     f"{place['residual']:.2f} m along the ground")
        for role, axes in place["residuals_rms"].items():
            lines.append(f"{role} RMS: " + ", ".join(
                f"{axis} {axes[axis]:.2f} m" for axis in AXES if axis in axes))
        lines += [f"warning: {text}" for text in place["warnings"]]
    return lines
