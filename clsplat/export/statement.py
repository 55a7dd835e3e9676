"""How exact a map is, in its record, the tags of its files and its last lines."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from clsplat.export.map_grid import ground_resolution
from clsplat.georeference import AXES, CHECK, CONTROL, Georeference
from clsplat.io.georeference.crs import heights_of
from clsplat.partition.region import map_axes
from clsplat.placement.plausible import recorded_doubts
from clsplat.scene import Scene

ROLES = (CHECK, CONTROL)


def stated(scene: Scene, crs: str | None, place: Georeference | None) -> dict[str, Any]:
    """What is known of a map's exactness, for RECORD: the ground sampling distance of the photos,
    the vertical reference, and the georeference with its residuals, metres."""
    result: dict[str, Any] = {"ground_sampling_distance": ground_resolution(scene)}
    if place is None or crs is None:
        return result
    errors = {role: {axis: error.rms for axis, error in place.errors(role).items()}
              for role in ROLES}
    flight = scene.unit * float(np.linalg.norm(np.ptp(
        [view.camera.position @ map_axes(scene.up).T for view in scene.views], axis=0)))
    return {**result,
            "vertical_reference": place.vertical or heights_of(place.crs).name or "unknown",
            "georeference": {"source": place.source, "residual": place.residual,
                             "residuals_rms": {role: axes for role, axes in errors.items() if axes},
                             "warnings": list(recorded_doubts(place, flight))}}


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
