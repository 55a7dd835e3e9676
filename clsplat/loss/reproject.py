"""Densification regularisation: a view's rendered depth against a source view's photo
(cl/reproject.cl).

A pixel of view i at depth z = depth / (1 - T) is found again in photo j; the squared difference of
the two colours pulls depths to where the photos agree (SIG, "Densification Regularization").
"""

import numpy as np

from clsplat.constants import GEOMETRY_REALS, TRANSFORM_REALS
from clsplat.device import Forms, Kernel, each, groups, items
from clsplat.loss.term import LossTerm
from clsplat.primitives.reduce import sum_columns
from clsplat.rendering.frame_arrays import FrameArray

_GRADS = dict(grad_depth=("real", "H", "W"), grad_transmittance=("real", "H", "W"))
REPROJECT = Kernel(
    "reproject.cl", "reproject", Forms(item=items("H"), group=groups("H", "SCAN_GROUP")),
    width="int", height="int", neighbour_width="int", neighbour_height="int",
    depth=("real", "H", "W"), transmittance=("real", "H", "W"), photo=("uchar", 3, "H", "W"),
    neighbour=("uchar", 3, "J", "K"), geometries=("real", "P", GEOMETRY_REALS),
    colours=("real", "P", TRANSFORM_REALS), pair="uint", **_GRADS, partials=("real", "H", 2))
SCALE = Kernel("reproject.cl", "scale_gradients", each("count"), count="uint", weight="real",
               sums=("real", 2), **_GRADS)


def pack_pairs(device, pairs):
    """real[P, 12] on the device, of P pairs (camera, neighbour): what takes a pixel of the first at
    a depth to one of the second.

    Both are clsplat.camera.Camera at the sizes of the images to be compared. H = K_j R K_i^-1,
    row-major, and K_j t, with R and t from camera to camera, K about pixel centres at whole
    numbers; formed in float64, so that far world origins cost nothing.
    """
    rows = np.array([_geometry(*pair) for pair in pairs])
    return device.upload(rows.reshape(-1, GEOMETRY_REALS))


def _geometry(camera, neighbour):
    rotation = neighbour.rotation @ camera.rotation.T
    translation = neighbour.translation - rotation @ camera.translation
    to_neighbour = _calibration(neighbour)
    homography = to_neighbour @ rotation @ np.linalg.inv(_calibration(camera))
    return np.concatenate([homography.reshape(-1), to_neighbour @ translation])


def _calibration(camera):
    (fx, fy), (cx, cy) = camera.focal, camera.centre
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])


def reproject(device, depth, transmittance, photo, neighbour, geometries, colours, pair, weight):
    """(sums real[2], grad_depth real[H, W], grad_transmittance real[H, W]) of a rendered depth
    channel and transmittance real[H, W].

    photo: uchar[3, H, W] of the rendered view; neighbour: uchar[3, H2, W2] of the adjacent one;
    geometries: `pack_pairs`; colours: real[P, 12], rows of 3 x 4 that take a neighbour's display
    values to the photo's exposure (last column added); pair: the row of both. sums: of squared
    colour differences, and the number of valid pixels. The loss is weight * sums[0] /
    max(sums[1], 1), and the gradients are of it: zero where a pixel is not valid
    (cl/reproject.cl), and always finite for a finite weight.
    """
    height, width = depth.shape
    _, neighbour_height, neighbour_width = neighbour.shape
    grads = dict(grad_depth=device.empty(depth.shape),
                 grad_transmittance=device.empty(depth.shape))
    partials = device.empty((height, 2))
    device.launch(REPROJECT, width=width, height=height, neighbour_width=neighbour_width,
                  neighbour_height=neighbour_height, depth=depth, transmittance=transmittance,
                  photo=photo, neighbour=neighbour, geometries=geometries, colours=colours,
                  pair=pair, **grads, partials=partials)
    sums = sum_columns(device, partials)
    device.launch(SCALE, count=height * width, weight=weight, sums=sums, **grads)
    return sums, grads["grad_depth"], grads["grad_transmittance"]


class Reprojection(LossTerm):
    """A view's depth against a source view, while the schedule gives it a weight."""

    name = "reprojection"
    needs_depth = needs_source = True

    @classmethod
    def is_used(cls, options):
        """Whether source views are compared with at all."""
        return options.reproject == "on"

    def weight(self, plan):
        """That of the schedule."""
        return plan.regularises

    def add_to(self, grad, frame, image, sample, weight):
        """As `LossTerm.add_to`; measures the sums of `reproject`."""
        blended = frame.blended
        sums, grad_depth, grad_transmittance = reproject(
            self.device, blended.depth, blended.transmittance, sample.photo, *sample.source, weight)
        grad.add(depth=grad_depth, transmittance=grad_transmittance)
        return sums

    def arrays(self, width, height, last):
        """As `LossTerm.arrays`."""
        return [FrameArray("partials", (height, 2), None, "reproject", "reproject"),
                *(FrameArray(name, (height, width), None, "reproject", "project adjoint")
                  for name in ("grad_depth", "grad_transmittance"))]
