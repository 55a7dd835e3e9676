"""Reads Mega-NeRF folders (Turki et al. 2022): Mill 19 and UrbanScene3D with its refined poses.

SCENE/coordinates.pt: origin_drb and pose_scale_factor; SCENE/{train,val}/metadata/NNNNNN.pt: W, H,
intrinsics (fx, fy, cx, cy) and c2w [3, 4]; SCENE/{train,val}/rgbs/NNNNNN.jpg; SCENE/mappings.txt:
lines "original photo,NNNNNN.pt". Camera axes of c2w are right, up, back; its world axes are down,
right, back (DRB), moved by the origin and divided by the scale: all that is undone, so that the
world is that of the COLMAP model the poses came from. The photos were undistorted when the folder
was made: `distortion` in the metadata is what they once had.
"""

from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.checks import LARGEST
from clsplat.io.cloud import read_cloud
from clsplat.io.posed import PosedPhoto, posed_scene
from clsplat.io.reason import clean
from clsplat.io.regular import read_regular
from clsplat.io.torch_archive import read_torch

TRAIN, VAL = "train", "val"
SUFFIXES = (".jpg", ".JPG", ".jpeg", ".png", ".PNG")
# world axes down, right, back to right, down, forward: its own inverse
DRB = np.array([(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])
AGAIN = "copy the data set again"


def has_metadata(folder):
    """Whether a folder is laid out as Mega-NeRF's."""
    return (folder / TRAIN / "metadata").is_dir()


def read_meganerf(folder):
    """The scene of a Mega-NeRF folder, recentred; the photos of val/ are held out.

    Points: see `cloud.read_cloud`, in the coordinates of the COLMAP model; else drawn. Whatever is
    damaged or missing raises InputError; no file is unpickled.
    """
    folder = Path(folder)
    path = folder / "coordinates.pt"
    table = _table(path)
    origin = _array(path, table, "origin_drb", (3,))
    scale = _array(path, table, "pose_scale_factor", ())
    shots = [_shot(metadata, part, origin, scale) for part in (TRAIN, VAL)
             for metadata in sorted((folder / part / "metadata").glob("*.pt"))]
    if all(shot.held_out for shot in shots):
        raise InputError(f"{folder / TRAIN / 'metadata'}: holds no metadata; {AGAIN}")
    _check_mappings(folder / "mappings.txt", {shot.source.stem for shot in shots})
    return posed_scene(folder, folder, shots, read_cloud(folder))


def _shot(path, part, origin, scale):
    table = _table(path)
    pose = _array(path, table, "c2w", (3, 4))
    pose[:, 3] = pose[:, 3] * scale + origin
    pose = DRB @ pose
    fx, fy, cx, cy = _array(path, table, "intrinsics", (4,)).tolist()
    size = tuple(int(_array(path, table, key, ())) for key in "WH")
    rgbs = path.parents[1] / "rgbs"
    photo = next((rgbs / (path.stem + suffix) for suffix in SUFFIXES
                  if (rgbs / (path.stem + suffix)).exists()), rgbs / f"{path.stem}.jpg")
    return PosedPhoto(f"{part}/{photo.name}", photo, size, (fx, fy), (cx, cy), pose, part == VAL)


def _table(path):
    table = read_torch(path)
    if not isinstance(table, dict):
        raise InputError(f"{path}: holds no table of names; {AGAIN}")
    return table


def _array(path, table, key, shape):
    """float64 of that shape, finite and below 1e15, of a tensor or a number."""
    value = table.get(key)
    try:
        if isinstance(value, (int, float, np.ndarray)):
            with np.errstate(invalid="ignore"):  # some NaN are refused below, not warned of
                value = np.array(value, np.float64)
            if value.shape == shape and (np.abs(value) <= LARGEST).all():
                return value
    except OverflowError:  # a whole number beyond float
        pass
    wish = f"array of {list(shape)} numbers" if shape else "number"
    raise InputError(f"{path}: {key} is missing, or no {wish}; {AGAIN}")


def _check_mappings(path, stems):
    """InputError where mappings.txt, if it is there, names metadata that is not."""
    if not path.exists():
        return
    try:
        lines = [line for line in read_regular(path).decode().splitlines() if line.strip()]
    except (OSError, ValueError):
        raise InputError(f"{path}: cannot be read as text; {AGAIN}") from None
    names = [line.rpartition(",")[2].strip() for line in lines]
    missing = [name for name in names if name.removesuffix(".pt") not in stems]
    if missing:
        raise InputError(f"{path}: {len(missing)} of its {len(names)} photos have no metadata, as "
                         f"{clean(missing[0])}; {AGAIN}, or remove those lines")
