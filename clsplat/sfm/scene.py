"""Writes a reconstruction as a scene: photos and masks as they are, and a sparse model; and what
sfm.json has on it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pycolmap

from clsplat.io.folders import link_file, make_folder
from clsplat.io.georeference.reconstruction import Placed
from clsplat.io.photos.masks import MASKS
from clsplat.io.records import plain
from clsplat.io.scenes.colmap import write_reconstruction
from clsplat.io.scenes.sources import IMAGES
from clsplat.sfm.database import image_id, partners
from clsplat.sfm.mapping import Mapped
from clsplat.sfm.photos import SourceCamera, SourcePhoto
from clsplat.sfm.progress import Progress

FEW_FEATURES = 100


def write_scene(folder: Path, reconstruction: Any, photos: Sequence[SourcePhoto],
                progress: Progress) -> list[str]:
    """Write images/, masks/ and sparse/0 of a scene.

    Photos and masks are hard links, so that the scene outlives its source without a second copy on
    the disk; on another file system they are copied. What is there already stays. The model has the
    cameras of the photos with their lens distortion.

    Parameters
    ----------
    folder : of the scene.
    reconstruction : a pycolmap.Reconstruction whose images have the names of photos; its points get
        their colours.

    Returns
    -------
    The names of the registered photos, sorted.
    """
    by_name = {photo.name: photo for photo in photos}
    names = sorted(image.name for image in reconstruction.images.values() if image.has_pose)
    for name in names:
        link_file(by_name[name].path, folder / IMAGES / name, "hard")
        mask = by_name[name].mask
        if mask is not None:
            link_file(mask, folder / MASKS / (name + mask.suffix), "hard")
    progress.phase("colours of points")
    reconstruction.extract_colors_for_all_images(folder / IMAGES)
    make_folder(folder / "sparse" / "0")
    write_reconstruction(folder / "sparse" / "0", reconstruction)
    return names


def record_of(mapped: Mapped, cameras: Sequence[SourceCamera], placed: Placed,
            missing: Mapping[str, str]) -> dict[str, Any]:
    """What sfm.json has on a reconstruction.

    Parameters
    ----------
    cameras : as they were known before.
    missing : names of the photos that were not registered, and the reasons.
    """
    model, known = mapped.reconstruction, placed.georeference
    registered = model.num_reg_images()
    control = known.residuals if known is not None and known.kind == "gcp" else ()
    record: dict[str, Any] = plain({
        "photos": registered + len(missing), "registered": registered, "not_registered": missing,
        "mapping": mapped.method, "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "mean_track_length": model.compute_mean_track_length(),
        "reprojection_error_pixels": model.compute_mean_reprojection_error(),
        "cameras": [{
            "model": camera.model_name, "width": camera.width, "height": camera.height,
            "parameters": camera.params, "photos": len(source.photos), "focal_before": source.focal,
            "focal_from": "by the maker" if source.calibration else
            "metadata" if source.focal_known else "guess"}
            for number, source in enumerate(cameras, 1) if number in model.cameras
            for camera in [model.cameras[number]]],
        "georeferenced": known is not None, "up": placed.up,
        "control_points": list(map(asdict, control)), "notes": placed.notes,
        "warnings": placed.warnings})
    return record


def reasons(database: Path, photos: Sequence[SourcePhoto], registered: Iterable[str],
            elsewhere: Iterable[int], known: Mapping[str, str]) -> dict[str, str]:
    """Why photos were not registered, by name.

    Parameters
    ----------
    registered : names of those that were.
    elsewhere : ids of photos that were placed in another part.
    known : reasons that were found before.
    """
    matches, result = partners(database), dict(known)
    with pycolmap.Database.open(database) as source:
        for number, photo in enumerate(photos, image_id(0)):
            if photo.name in registered or photo.name in result:
                continue
            found = source.num_keypoints_for_image(number)
            result[photo.name] = (
                "was placed in another part, which nothing joins to this one"
                if number in elsewhere else
                f"has only {found} features: it is blurred or shows hardly any detail"
                if found < FEW_FEATURES else "matches no other photo" if not matches[number] else
                f"matches {matches[number]} photos, but its pose could not be determined")
    return result
