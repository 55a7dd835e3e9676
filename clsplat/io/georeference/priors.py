"""Bundle adjustment in which measured positions of photos take part, as priors.

Photos determine the shape of a scene well nearby and badly over long distances: a lens that is not
quite known makes a bowl of long strips, which no similarity takes out. Measured positions are the
other way round. Both are least squares, so they are weighed by their standard deviations: S of a
position, metres, and that of a pixel coordinate, P. The sum to minimise is that of (pixels / P)^2
and (metres / S)^2 or, as the adjustment has pixels as they are, of pixels^2 and (metres * P / S)^2:
a prior has the covariance (S / P)^2.

A position that contradicts the photos has little weight (Cauchy's loss). If most of a kind, along
the ground or in height, are worse than their standard deviations say, these grow and the adjustment
begins again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from clsplat.placement.alignment import CAUCHY, LEAST_STD

ROUNDS = 3  # at most, of adjustments with larger standard deviations
BELIEVED = 1.5  # times a standard deviation; residuals that are larger make it grow
RAYLEIGH_MEAN = np.sqrt(np.pi / 2)  # lengths of errors with a standard deviation of 1 an axis
MEDIANS = 1.177, 0.674  # of such lengths along the ground, and of sizes in height
LEAST_PIXEL_STD = 0.05


@dataclass(frozen=True)
class PriorEffect:
    """What the positions of photos changed as priors."""

    # photos, heights: how many positions, and of these heights, took part
    photos: int
    heights: int
    # metres, along an axis of the ground and in height: medians of the standard deviations
    std: tuple[float, float | None]
    # before, after: metres, RMS of the residuals along the ground and in height of those positions,
    # before and after the adjustment; None in height without heights
    before: tuple[float, float | None]
    after: tuple[float, float | None]
    moved: tuple[float, float]  # metres, by which cameras moved: the median and the largest
    focal_percent: float  # by which focal lengths changed, the largest

    def __str__(self) -> str:
        residuals = [
            f"{before:.3g} to {after:.3g} m {way}"
            for before, after, way in zip(self.before, self.after, ("along the ground", "in height"))
            if after is not None
        ]
        std = " and ".join(f"{value:.2g}" for value in self.std if value is not None)
        return (
            f"adjusted to the positions of {self.photos} photos, with standard deviations of "
            f"{std} m: residual from {' and from '.join(residuals)}; cameras moved by "
            f"{self.moved[0]:.2g} m, the farthest by {self.moved[1]:.2g} m, and the focal "
            f"length changed by {self.focal_percent:.2g} %"
        )


def adjust_to_positions(
    reconstruction: Any,
    images: Sequence[Any],
    positions: NDArray[np.float64],
    std: NDArray[np.float64],
    has_height: NDArray[np.bool_],
    keep_focal: bool,
    refine_centre: bool,
    replaced: Callable[[], None] | None,
) -> PriorEffect:
    """Adjust cameras and points of a reconstruction, nearly in its place, to measured positions.

    Parameters
    ----------
    images : those with a position, pycolmap.Image of the reconstruction.
    positions, std : float64[N, 3], metres, in its axes east, north and up.
    has_height : bool[N], whose heights are measured; others only hold the scene level.
    keep_focal : whether focal lengths are known better than from photos and positions.
    refine_centre : whether principal points are fitted, too.
    replaced : moves the adjusted reconstruction as a whole, before its residuals are taken; None:
        the positions decide where it lies.
    """
    everything = [image for image in reconstruction.images.values() if image.has_pose]
    std = np.maximum(std, LEAST_STD)
    focals = _focals(reconstruction)
    start, before = centres_of(everything), rms(centres_of(images) - positions, has_height)
    pixel_std = _pixel_std(reconstruction)
    config, options = pycolmap.BundleAdjustmentConfig(), pycolmap.BundleAdjustmentOptions()
    for image in everything:
        config.add_image(image.image_id)
    options.print_summary, options.refine_focal_length = False, not keep_focal
    options.refine_principal_point = refine_centre
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    # whitened, the errors of pixels and of priors have this standard deviation
    options.ceres.loss_function_scale = float(np.sqrt(CAUCHY)) * pixel_std
    # the bowl of a long strip changes the sum little: short steps would end before it is out
    options.ceres.solver_options.initial_trust_region_radius = 1e8
    options.ceres.solver_options.function_tolerance = 1e-5
    for _ in range(ROUNDS):
        _adjust(reconstruction, images, positions, std / pixel_std, config, options)
        away = (centres_of(images) - positions) / std
        excess = [
            float(np.median(sizes)) / median if len(sizes) else 0.0
            for sizes, median in zip((np.linalg.norm(away[:, :2], axis=1), np.abs(away[has_height, 2])), MEDIANS)
        ]
        if max(excess) <= BELIEVED:
            break
        std = std * np.maximum(1.0, [excess[0], excess[0], excess[1]])
    if replaced is not None:
        replaced()
    moved = np.linalg.norm(centres_of(everything) - start, axis=1)
    changes = 100 * (_focals(reconstruction) / focals - 1)
    return PriorEffect(
        len(images),
        int(has_height.sum()),
        (_round(np.median(std[:, :2])), _round(np.median(std[has_height, 2])) if has_height.any() else None),
        before,
        rms(centres_of(images) - positions, has_height),
        (_round(np.median(moved)), _round(moved.max())),
        _round(max(changes, key=abs)),
    )


def _adjust(
    reconstruction: Any,
    images: Sequence[Any],
    positions: NDArray[np.float64],
    std: NDArray[np.float64],
    config: Any,
    options: Any,
) -> None:
    """One adjustment, with standard deviations as metres to a pixel's."""
    priors = [
        pycolmap.PosePrior(
            corr_data_id=image.data_id,
            position=position,
            position_covariance=np.diag(deviations**2),
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for image, position, deviations in zip(images, positions, std)
    ]
    of_priors = pycolmap.PosePriorBundleAdjustmentOptions()
    of_priors.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    of_priors.ceres.prior_position_loss_scale = options.ceres.loss_function_scale
    # it first aligns the reconstruction with the positions, of which none is an outlier any more
    of_priors.alignment_ransac.random_seed, of_priors.alignment_ransac.max_error = 0, 1e9
    pycolmap.create_pose_prior_bundle_adjuster(options, of_priors, config, priors, reconstruction).solve()
    reconstruction.update_point_3d_errors()


def _pixel_std(reconstruction: Any) -> float:
    """The standard deviation of a pixel coordinate, by the mean reprojection error and by how many
    of the coordinates only determine points and cameras."""
    reconstruction.update_point_3d_errors()
    observed = 2 * reconstruction.compute_num_observations()
    spare = observed - 3 * reconstruction.num_points3D() - 6 * reconstruction.num_reg_images()
    length = reconstruction.compute_mean_reprojection_error() / RAYLEIGH_MEAN
    return max(LEAST_PIXEL_STD, float(length * np.sqrt(observed / max(spare, observed / 10))))


def centres_of(images: Sequence[Any]) -> NDArray[np.float64]:
    """Where images of a reconstruction were taken, float64[N, 3]."""
    return np.array([image.projection_center() for image in images]).reshape(-1, 3)


def rms(away: NDArray[np.float64], has_height: NDArray[np.bool_]) -> tuple[float, float | None]:
    """Root mean squares of residuals [N, 3] along the ground and in height; None without any."""
    heights = away[has_height, 2]
    return (
        _round(np.sqrt((away[:, :2] ** 2).sum(axis=1).mean())),
        _round(np.sqrt((heights**2).mean())) if len(heights) else None,
    )


def _focals(reconstruction: Any) -> NDArray[np.float64]:
    return np.array([camera.mean_focal_length() for camera in reconstruction.cameras.values()])


def _round(value: Any) -> float:
    return round(float(value), 4)
