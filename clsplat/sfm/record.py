"""sfm.json: what was registered, what was not and why, how well it fits, and how long it took."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pycolmap

from clsplat.georeference import Residual
from clsplat.io.georeference.reconstruction import Placed
from clsplat.io.records import plain
from clsplat.sfm.database import image_id, partners
from clsplat.sfm.mapping import Mapped
from clsplat.sfm.photos import SourceCamera, SourcePhoto

FEW_FEATURES = 100


def record_of(mapped: Mapped, cameras: Sequence[SourceCamera], placed: Placed,
              missing: Mapping[str, str]) -> dict[str, Any]:
    """Describe a reconstruction.

    Parameters
    ----------
    cameras : as they were known before.
    missing : names of the photos that were not registered, and the reasons.
    """
    model = mapped.reconstruction
    registered = model.num_reg_images()
    record: dict[str, Any] = plain({
        "photos": registered + len(missing), "registered": registered, "not_registered": missing,
        "mapping": mapped.method, "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "mean_track_length": model.compute_mean_track_length(),
        "reprojection_error_pixels": model.compute_mean_reprojection_error(),
        "cameras": [_camera(model.cameras[number], source)
                    for number, source in enumerate(cameras, 1) if number in model.cameras],
        "georeferenced": placed.georeference is not None, "up": placed.up,
        "control_points": [asdict(each) for each in _control(placed)], "notes": placed.notes,
        "warnings": placed.warnings})
    return record


def _control(placed: Placed) -> tuple[Residual, ...]:
    known = placed.georeference
    return known.residuals if known is not None and known.kind == "gcp" else ()


def _camera(camera: Any, source: SourceCamera) -> dict[str, Any]:
    origin = ("by the maker" if source.calibration else
              "metadata" if source.focal_known else "guess")
    return {"model": camera.model_name, "width": camera.width, "height": camera.height,
            "parameters": camera.params, "photos": len(source.photos),
            "focal_before": source.focal, "focal_from": origin}


def reasons(database: Path, photos: Sequence[SourcePhoto], registered: Collection[str],
            elsewhere: Iterable[int], known: Mapping[str, str]) -> dict[str, str]:
    """Why photos were not registered, by name.

    Parameters
    ----------
    registered : names of those that were.
    elsewhere : indices of photos that were placed in another part.
    known : reasons that were found before.
    """
    matches = partners(database)
    source = pycolmap.Database.open(database)
    try:
        result, others = dict(known), set(elsewhere)
        for index, photo in enumerate(photos):
            if photo.name in registered or photo.name in result:
                continue
            found = source.num_keypoints_for_image(image_id(index))
            if index in others:
                reason = "was placed in another part, which nothing joins to this one"
            elif found < FEW_FEATURES:
                reason = f"has only {found} features: it is blurred or shows hardly any detail"
            elif not matches[index]:
                reason = "matches no other photo"
            else:
                reason = f"matches {matches[index]} photos, but its pose could not be determined"
            result[photo.name] = reason
    finally:
        source.close()
    return result
