"""Real spherical harmonics (SH) in the order and sign of 3DGS, and how they rotate."""

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians

# of an exact fit, more directions than the 7 harmonics of the highest band
_GOLDEN = np.pi * (3 - np.sqrt(5))
_HEIGHTS = 1 - (np.arange(16) + 0.5) / 8
DIRECTIONS = np.stack([np.sqrt(1 - _HEIGHTS**2) * np.cos(_GOLDEN * np.arange(16)),
                       np.sqrt(1 - _HEIGHTS**2) * np.sin(_GOLDEN * np.arange(16)), _HEIGHTS],
                      axis=1)


def used_sh_degree(gaussians: Gaussians) -> int:
    """The highest degree of the spherical harmonics that is not zero everywhere."""
    degree = gaussians.sh_degree
    while degree and not gaussians.sh_rest[:, degree**2 - 1:(degree + 1) ** 2 - 1].any():
        degree -= 1
    return degree


def harmonics(directions: NDArray[np.floating]) -> NDArray[np.float64]:
    """The harmonics of degree 1 to 3, those of cl/include/harmonics.h.

    Parameters
    ----------
    directions : [N, 3], unit vectors.

    Returns
    -------
    [N, 15].
    """
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack([
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy), -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy)], axis=1)


def wigner(rotation: NDArray[np.floating], degree: int) -> NDArray[np.float64]:
    """The Wigner matrix of a band, which rotates its coefficients.

    A rotation maps the harmonics of a band to sums of themselves. Since a few directions determine
    these sums, a least-squares fit finds the matrix to rounding, without the recurrences of the
    closed form and their conventions.

    Parameters
    ----------
    rotation : [3, 3], from the old frame to the new one.
    degree : of the band, 1 to 3.

    Returns
    -------
    [2 degree + 1, 2 degree + 1]; coefficients in the new frame are this times the old ones.
    """
    band = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
    new = harmonics(DIRECTIONS @ np.asarray(rotation, np.float64).T)[:, band]
    return np.asarray(np.linalg.lstsq(new, harmonics(DIRECTIONS)[:, band])[0], np.float64)


def rotated(sh_rest: NDArray[np.floating], rotation: NDArray[np.floating]) -> NDArray[np.float32]:
    """The harmonics of gaussians in a rotated frame.

    Parameters
    ----------
    sh_rest : [N, bands, 3].
    rotation : [3, 3], from the old frame to the new one.
    """
    result = np.empty(sh_rest.shape, np.float32)
    degree = 1
    while (degree + 1) ** 2 - 1 <= sh_rest.shape[1]:
        band = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        result[:, band] = np.einsum("ij,njc->nic", wigner(rotation, degree), sh_rest[:, band])
        degree += 1
    return result
