"""Clouds of points with colours, as the gaussians from which a training starts."""

from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.fields import LARGEST_COORDINATE
from clsplat.io.models.usable import usable

COLOURS = ("red", "green", "blue")
GREY = 128
FAR = 1e4  # units from the origin, from which a cloud gets local coordinates of its own


def is_cloud(element: plyfile.PlyElement) -> bool:
    """Whether vertices are points rather than gaussians."""
    names = element.data.dtype.names
    return all(name in names for name in "xyz") and not any(
        name.startswith(("f_dc_", "scale_", "rot_", "opacity")) for name in names)


def ply_cloud(path: Path, element: plyfile.PlyElement, offset: NDArray[np.float64] | None
              ) -> Gaussians:
    """The gaussians of a PLY of points; see `models.read_model`."""
    rows = element.data
    if any(rows.dtype[name].kind not in "fiu" for name in "xyz"):
        raise InputError(f"{path}: x, y or z of its points is a list; export the cloud again")
    colours = None
    if all(name in rows.dtype.names and rows.dtype[name].kind in "fiu" for name in COLOURS):
        colours = np.stack([rows[name] for name in COLOURS], axis=1)
    points = np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)
    return cloud_gaussians(path, points, colours, offset)


def cloud_gaussians(path: Path, points: NDArray[np.float64],
                    colours: NDArray[np.generic] | None, offset: NDArray[np.float64] | None
                    ) -> Gaussians:
    """Gaussians on points, of SH degree 0, in local coordinates.

    Parameters
    ----------
    path : the file that messages name.
    points : float64[N, 3], original coordinates.
    colours : [N, 3], of 8 or 16 bits, or float from 0 to 1; None: grey.
    offset : float64[3], original coordinates of the origin of the local ones; None: zero, or, far
        from there, the middle of the points in whole units.

    Raises
    ------
    InputError : fewer than two places, or more than half of the coordinates are not finite or too
        large; see `usable.usable`.
    """
    rows: dict[str, NDArray[Any]] = {
        "positions": np.where(np.abs(points) <= LARGEST_COORDINATE, points, np.nan)}
    if colours is not None:
        rows["colours"] = np.nan_to_num(colours)
    rows = usable(path, rows)
    points, colours = rows["positions"], rows.get("colours")
    if not len(points) or (points == points[0]).all():
        raise InputError(f"{path}: its {len(points)} points have fewer than two places; gaussians "
                         "take their size from the distance of points, so give a larger cloud")
    if offset is None:
        middle = np.rint(np.median(points, axis=0))
        offset = middle if np.abs(middle).max() > FAR else np.zeros(3)
    shown = np.full(points.shape, GREY, np.uint8) if colours is None else _bytes(colours)
    return Gaussians.from_points(points - offset, shown, 0).located(offset)


def _bytes(colours: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Colours of 8 bits. Some programs write 8 bits into 16, without multiplying."""
    values = colours.astype(np.float64)
    if colours.dtype.kind == "f":
        values = values * 255
    elif values.max(initial=0) > 255:
        values = values / 257
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
