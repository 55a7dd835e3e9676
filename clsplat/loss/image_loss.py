"""L1 and D-SSIM against a photo, with the gradient (cl/image_loss.cl)."""

from clsplat.device import Kernel
from clsplat.primitives.reduce import sum_columns

STRIP = 64  # rows a work-item of the item form slides down

_SIZE = dict(width="int", height="int", strip="int")
_IMAGES = dict(image=("real", 3, "H", "W"), photo=("uchar", 3, "H", "W"),
               maps=("real", 3, 3, "H", "W"))
VALUE = Kernel("image_loss.cl", "image_loss", **_SIZE, **_IMAGES, partials=("real", "P", 2))
ADJOINT = Kernel("image_loss.cl", "image_loss_adjoint", **_SIZE, l1_scale="real",
                 ssim_scale="real", **_IMAGES, grad_image=("real", 3, "H", "W"))


def image_loss(device, image, photo, ssim_weight):
    """(sums real[2], grad_image real[3, H, W]) of an image real[3, H, W] against a photo
    uchar[3, H, W], both in display values.

    sums: of |x - y| and of SSIM over 3 H W values; `loss_value` makes the loss of them. The
    gradient is that of the loss, a mean over all values.
    """
    _, height, width = image.shape
    values = 3 * height * width
    if device.form == "item":
        group, items = 1, 3 * -(-width // 16) * -(-height // STRIP)
    else:
        group, items = device.tile**2, 3 * -(-width // device.tile) * -(-height // device.tile)
    defines = (("TILE", device.tile), ("GROUP", device.tile**2))
    size = dict(width=width, height=height, strip=STRIP)
    maps, partials = device.empty((3, 3, height, width)), device.empty((items, 2))
    grad_image = device.empty((3, height, width))
    device.launch(VALUE, items * group, group, defines, **size, image=image, photo=photo,
                  maps=maps, partials=partials)
    device.launch(ADJOINT, items * group, group, defines, **size,
                  l1_scale=(1 - ssim_weight) / values, ssim_scale=-ssim_weight / values,
                  image=image, photo=photo, maps=maps, grad_image=grad_image)
    return sum_columns(device, partials), grad_image


def loss_value(sums, values, ssim_weight):
    """(loss, mean |x - y|, mean SSIM) from the sums of `image_loss` over so many values; waits."""
    l1, ssim = (float(v) / values for v in sums.download())
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), l1, ssim
