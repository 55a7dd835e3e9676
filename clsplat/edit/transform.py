"""Similarity transforms of gaussians: scale, rotate with their spherical harmonics, and move."""

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.values import unit

SINGLE = np.finfo(np.float32)
LARGEST_LOG = 87.0  # of a scale that single precision holds, and of its inverse
BANDS = (slice(0, 3), slice(3, 8), slice(8, 15))  # of the harmonics above the constant
DIRECTIONS = np.random.default_rng(0).normal(size=(32, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def transformed(
    gaussians: Gaussians,
    scale: float = 1.0,
    rotation: ArrayLike | None = None,
    translation: ArrayLike = (0.0, 0.0, 0.0),
) -> Gaussians:
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
    matrix = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):  # the result is checked
        moved = gaussians.without_spheres().scaled(scale)
        rows = dict(moved.rows)
        if rotation is not None:
            rows["positions"] = (moved.positions.astype(np.float64) @ matrix.T).astype(np.float32)
            x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(matrix).as_quat()
            left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
            rows["quaternions"] = (moved.quaternions.astype(np.float64) @ left.T).astype(np.float32)
            rows["sh_rest"] = rotated(moved.sh_rest, matrix)
        offset = scale * matrix @ gaussians.offset + np.asarray(translation, np.float64)
        far = np.abs(rows["positions"].astype(np.float64)).max(axis=0, initial=0.0) + np.abs(offset)
    before, after = (np.abs(scales) > LARGEST_LOG for scales in (gaussians.log_scales, rows["log_scales"]))
    if (after & ~before).any() or not (far < SINGLE.max).all():
        raise InputError(
            f"{gaussians.count:,} gaussians: after this --scale, --rotate and "
            f"--translate coordinates or sizes are beyond {SINGLE.tiny:.0e} to "
            f"{SINGLE.max:.0e}, which single precision holds; give numbers nearer to 1"
        )
    return Gaussians(rows, moved.sh_degree, offset)


def half_axes(gaussians: Gaussians) -> NDArray[np.float64]:
    """float64[N, 3, 3]: the principal axes of the gaussians in columns, as long as their standard
    deviations, so that a covariance is the product with the transposed."""
    axes: NDArray[np.float64] = scipy.spatial.transform.Rotation.from_quat(
        unit(gaussians.quaternions)[:, [1, 2, 3, 0]]
    ).as_matrix()
    return axes * np.exp(gaussians.log_scales.astype(np.float64))[:, None]


def harmonics(directions: NDArray[np.floating]) -> NDArray[np.float64]:
    """The real spherical harmonics of degree 1 to 3, [N, 15], of unit vectors [N, 3], in the order
    and sign of 3DGS (cl/include/harmonics.h)."""
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack(
        [
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        axis=1,
    )


def rotated(sh_rest: NDArray[np.floating], rotation: NDArray[np.floating]) -> NDArray[np.float32]:
    """The harmonics of gaussians in a rotated frame.

    A rotation maps the harmonics of a band to sums of themselves (the Wigner matrix). Since a few
    directions determine these sums, a least-squares fit finds them to rounding.

    Parameters
    ----------
    sh_rest : [N, bands, 3].
    rotation : [3, 3], from the old frame to the new one.
    """
    result = np.empty(sh_rest.shape, np.float32)
    old, new = harmonics(DIRECTIONS), harmonics(DIRECTIONS @ np.asarray(rotation, np.float64).T)
    for band in (band for band in BANDS if band.stop <= sh_rest.shape[1]):
        wigner = np.linalg.lstsq(new[:, band], old[:, band])[0]
        result[:, band] = np.einsum("ij,njc->nic", wigner, sh_rest[:, band])
    return result
