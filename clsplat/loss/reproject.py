"""Densification regularisation: a view's rendered depth against a source view's photo
(cl/reproject.cl).

A pixel of view i at depth z = depth / (1 - T) is projected into photo j; the squared difference of
the two colours pulls depths to where the photos agree (SIG, "Densification Regularization").
"""

from collections.abc import Iterable

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import GEOMETRY_REALS, TRANSFORM_REALS
from clsplat.device import Array, Device, Forms, Kernel, each, groups, items
from clsplat.loss.image_loss import is_masked
from clsplat.primitives.reduce import sum_columns
from clsplat.stereo.sweep import plane_warp

_GRADS = dict(grad_depth=("real", "H", "W"), grad_transmittance=("real", "H", "W"))
REPROJECT = Kernel(
    "reproject.cl",
    "reproject",
    Forms(item=items("H"), group=groups("H", "SCAN_GROUP")),
    width="int",
    height="int",
    neighbour_width="int",
    neighbour_height="int",
    masked="int",
    neighbour_masked="int",
    depth=("real", "H", "W"),
    transmittance=("real", "H", "W"),
    photo=("uchar", "C", "H", "W"),
    neighbour=("uchar", "D", "J", "K"),
    geometries=("real", "P", GEOMETRY_REALS),
    colours=("real", "P", TRANSFORM_REALS),
    pair="uint",
    **_GRADS,
    partials=("real", "H", 2),
)
SCALE = Kernel(
    "reproject.cl", "scale_gradients", each("count"), count="uint", weight="real", sums=("real", 2), **_GRADS
)


def pack_pairs(device: Device, pairs: Iterable[tuple[Camera, Camera]]) -> Array:
    """Transforms real[P, 12] that take a pixel of one view, at a depth, to a pixel of its
    neighbour.

    H = K_j R K_i^-1, row-major, and K_j t, where R and t are from camera i to camera j, and K has
    pixel centres at whole numbers. They are computed in float64, so that a far world origin costs
    no precision. The cameras have the sizes of the images that are compared.
    """
    rows = np.array([plane_warp(*pair, first_centre=0.0) for pair in pairs])
    return device.upload(rows.reshape(-1, GEOMETRY_REALS))


def reproject(
    device: Device,
    depth: Array,
    transmittance: Array,
    photo: Array,
    neighbour: Array,
    geometries: Array,
    colours: Array,
    pair: int,
    weight: float,
) -> tuple[Array, Array, Array]:
    """The reprojection loss of a rendered view, and its gradients.

    Parameters
    ----------
    depth, transmittance : real[H, W], rendered.
    photo : uchar[3 or 4, H, W], of the rendered view.
    neighbour : uchar[3 or 4, H2, W2], the source view's photo.
    geometries : real[P, 12], of `pack_pairs`.
    colours : real[P, 12], transforms of 3 x 4 from a source photo's display values to the photo's.
    pair : the row of this pair of views in both.
    weight : of the loss.

    Returns
    -------
    real[2], the sum of squared colour differences and the number of valid pixels: the loss is
    weight * sums[0] / max(sums[1], 1). Then its gradients by depth and by transmittance, real[H, W]
    each: zero where a pixel is not valid (cl/reproject.cl), and finite for a finite weight.
    """
    height, width = depth.shape
    _, neighbour_height, neighbour_width = neighbour.shape
    grads = dict(grad_depth=device.empty(depth.shape), grad_transmittance=device.empty(depth.shape))
    partials = device.empty((height, 2))
    device.launch(
        REPROJECT,
        width=width,
        height=height,
        neighbour_width=neighbour_width,
        neighbour_height=neighbour_height,
        masked=is_masked(photo),
        neighbour_masked=is_masked(neighbour),
        depth=depth,
        transmittance=transmittance,
        photo=photo,
        neighbour=neighbour,
        geometries=geometries,
        colours=colours,
        pair=pair,
        **grads,
        partials=partials,
    )
    sums = sum_columns(device, partials)
    device.launch(SCALE, count=height * width, weight=weight, sums=sums, **grads)
    return sums, grads["grad_depth"], grads["grad_transmittance"]
