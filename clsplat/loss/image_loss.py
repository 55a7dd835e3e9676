"""L1 and D-SSIM against a photo, with the gradient (cl/image_loss.cl)."""

import numpy as np

from clsplat.device import Forms, Kernel, groups, items
from clsplat.loss.term import LossTerm
from clsplat.primitives.reduce import sum_columns
from clsplat.rendering.frame_arrays import FrameArray

STRIP = 128  # rows a work-item of the item form slides down
CHANNELS = Forms(item=1, group=3)  # a launch: a CPU's cache holds the maps of one

_SIZE = dict(width="int", height="int", strip="int", first_channel="int")
_IMAGES = dict(image=("real", 3, "H", "W"), photo=("uchar", 3, "H", "W"),
               maps=("real", "M", 3, "H", "W"))
_TILES = Forms(item=items("M W/16 H/strip"), group=groups("M W/TILE H/TILE", "TILE TILE"))
VALUE = Kernel("image_loss.cl", "image_loss", _TILES, **_SIZE, **_IMAGES, partials=("real", "P", 2))
ADJOINT = Kernel("image_loss.cl", "image_loss_adjoint", _TILES, **_SIZE, l1_scale="real",
                 ssim_scale="real", **_IMAGES, grad_image=("real", 3, "H", "W"))


def image_loss(device, image, photo, ssim_weight):
    """(sums real[2], grad_image real[3, H, W]) of an image real[3, H, W] against a photo
    uchar[3, H, W], both in display values.

    sums: of |x - y| and of SSIM over 3 H W values; `loss_value` makes the loss of them. The
    gradient is that of the loss, a mean over all values.
    """
    _, height, width = image.shape
    values = 3 * height * width
    channels = CHANNELS.of(device)
    rows = VALUE.units(device, M=3, W=width, H=height, strip=STRIP)
    maps = device.empty((channels, 3, height, width))
    partials, grad_image = device.empty((rows, 2)), device.empty((3, height, width))
    for first_channel in range(0, 3, channels):
        shared = dict(width=width, height=height, strip=STRIP, first_channel=first_channel,
                      image=image, photo=photo, maps=maps)
        device.launch(VALUE, **shared, partials=partials)
        device.launch(ADJOINT, **shared, l1_scale=(1 - ssim_weight) / values,
                      ssim_scale=-ssim_weight / values, grad_image=grad_image)
    return sum_columns(device, partials), grad_image


def loss_value(sums, values, ssim_weight):
    """(loss, mean |x - y|, mean SSIM) from the sums of `image_loss` over so many values; waits."""
    l1, ssim = (float(v) / values for v in sums.download())
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), l1, ssim


class ImageLoss(LossTerm):
    """The image against its photo: what every training minimises."""

    name = "image"

    def add_to(self, grad, frame, image, sample, weight):
        """As `LossTerm.add_to`; measures the sums of `image_loss`, and over how many values."""
        sums, grad_image = image_loss(self.device, image, sample.photo, self.options.ssim_weight)
        grad.add(image=grad_image)
        _, height, width = image.shape
        return sums, 3 * height * width

    def arrays(self, width, height, last):
        """As `LossTerm.arrays`."""
        rows = VALUE.units(self.device, M=3, W=width, H=height, strip=STRIP)
        return [FrameArray("maps", (CHANNELS.of(self.device), 3, height, width), None, "loss",
                           "loss"),
                FrameArray("partials", (rows, 2), None, "loss", "loss"),
                FrameArray("grad_image", (3, height, width), None, "loss", last)]

    def values(self, measured):
        """The loss, mean |x - y| and mean SSIM, each a mean over the views."""
        found = [loss_value(sums, count, self.options.ssim_weight) for sums, count in measured]
        return dict(zip(("loss", "l1", "ssim"), np.mean(found, axis=0).tolist()))
