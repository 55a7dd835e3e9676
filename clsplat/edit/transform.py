"""Similarity transforms of gaussians: scale, rotate and move."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from clsplat.edit.harmonics import rotated
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.quantise import unit

SINGLE = np.finfo(np.float32)
LARGEST_LOG = 87.0  # of a scale that single precision holds, and of its inverse


def transformed(gaussians: Gaussians, scale: float = 1.0, rotation: ArrayLike | None = None,
                translation: ArrayLike = (0.0, 0.0, 0.0)) -> Gaussians:
    """The gaussians at `translation` + `scale` * `rotation` @ original coordinates.

    Parameters
    ----------
    gaussians : the model; fields of SPHERE are left out.
    scale : more than 0.
    rotation : float[3, 3]; None: no rotation. The spherical harmonics are rotated with it.
    translation : float[3], original coordinates.

    Raises
    ------
    InputError : single precision does not hold the result.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        result = _moved(gaussians, scale, rotation, translation)
        far = np.abs(result.positions.astype(np.float64)).max(axis=0, initial=0.0) + np.abs(
            result.offset)
    lost = ((np.abs(result.log_scales) > LARGEST_LOG)
            & (np.abs(gaussians.log_scales) <= LARGEST_LOG)).any()
    if lost or not (far < SINGLE.max).all():
        raise InputError(f"{result.count:,} gaussians: after this --scale, --rotate and "
                         f"--translate coordinates or sizes are beyond {SINGLE.tiny:.0e} to "
                         f"{SINGLE.max:.0e}, which single precision holds; give numbers nearer to 1"
                         )
    return result


def _moved(gaussians: Gaussians, scale: float, rotation: ArrayLike | None,
           translation: ArrayLike) -> Gaussians:
    matrix = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    moved = gaussians.without_spheres()
    if scale != 1:
        moved = moved.scaled(scale)
    rows = dict(moved.rows)
    if rotation is not None:
        rows["positions"] = (moved.positions.astype(np.float64) @ matrix.T).astype(np.float32)
        rows["quaternions"] = _turned(moved.quaternions, matrix)
        rows["sh_rest"] = rotated(moved.sh_rest, matrix)
    offset = scale * matrix @ gaussians.offset + np.asarray(translation, np.float64)
    return Gaussians(rows, moved.sh_degree, offset)


def half_axes(gaussians: Gaussians) -> NDArray[np.float64]:
    """float64[N, 3, 3]: the principal axes of the gaussians in columns, as long as their standard
    deviations, so that a covariance is the product with the transposed."""
    quaternions = unit(gaussians.quaternions)[:, [1, 2, 3, 0]]
    axes: NDArray[np.float64] = Rotation.from_quat(quaternions).as_matrix() * np.exp(
        gaussians.log_scales.astype(np.float64))[:, None]
    return axes


def turn(degrees: ArrayLike) -> NDArray[np.float64]:
    """[3, 3]: rotations by angles [3] about the x, then the y, then the z axis, which stay fixed.

    They are right-handed: a positive angle about z turns x towards y.
    """
    matrix: NDArray[np.float64] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    return matrix


def _turned(quaternions: NDArray[np.float32], matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    """Quaternions [N, 4], wxyz of any length, after a rotation; their lengths stay."""
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.asarray(quaternions.astype(np.float64) @ left.T, np.float32)
