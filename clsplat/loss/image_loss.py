"""L1 and D-SSIM against a photo, with the gradient (cl/image_loss.cl)."""

from typing import Any

from clsplat.device import Array, Device, Forms, Kernel, groups, items
from clsplat.primitives.reduce import sum_columns
from clsplat.rendering.blend import Defines

HAS_MAPS = Forms(item=False, group=True)  # whether the gradient has a kernel of its own
STRIP_ROWS = 256  # image rows of a work-item of the item form, which reads 20 more

_SIZE = dict(width="int", height="int")
_IMAGES = dict(image=("real", 3, "H", "W"), photo=("uchar", "C", "H", "W"))
_MAPS: dict[str, Any] = dict(maps=("real", 3, 3, "H", "W"))
_GRADIENT: dict[str, Any] = dict(l1_scale="real", ssim_scale="real", grad_image=("real", 3, "H", "W"))
_TILES = "3 W/32 H/22", "TILE 8"
VALUE = Kernel(
    "image_loss.cl",
    "image_loss",
    Forms(item=items("3 W/64 H/strip", strip="int", **_GRADIENT), group=groups(*_TILES, **_MAPS)),
    **_SIZE,
    **_IMAGES,
    partials=("real", "P", 2),
)
ADJOINT = Kernel(
    "image_loss.cl",
    "image_loss_adjoint",
    Forms(item=None, group=groups(*_TILES)),
    **_SIZE,
    **_IMAGES,
    **_MAPS,
    **_GRADIENT,
)


def image_loss(device: Device, image: Array, photo: Array, ssim_weight: float) -> tuple[Array, Array]:
    """The loss of an image against a photo, and its gradient.

    Parameters
    ----------
    image : real[3, H, W], display values.
    photo : uchar[3, H, W], or uchar[4, H, W] with a mask (cl/image_loss.cl).
    ssim_weight : share of D-SSIM in the loss, the rest is L1.

    Returns
    -------
    real[P, 2], partial sums of |x - y| and of SSIM over 3 H W values, for `loss_value`;
    real[3, H, W], the gradient of the loss, which is a mean over these values.
    """
    _, height, width = image.shape
    values = 3 * height * width
    rows = VALUE.units(device, W=width, H=height, strip=STRIP_ROWS)
    partials, grad_image = device.result((rows, 2)), device.empty((3, height, width))
    shared = dict(
        width=width,
        height=height,
        image=image,
        photo=photo,
        maps=device.empty((3, 3, height, width)) if HAS_MAPS.of(device) else None,
        l1_scale=(1 - ssim_weight) / values,
        ssim_scale=-ssim_weight / values,
        grad_image=grad_image,
    )
    defines = mask_defines(is_masked(photo))
    device.launch(VALUE, defines, **shared, strip=STRIP_ROWS, partials=partials)
    if HAS_MAPS.of(device):
        device.launch(ADJOINT, defines, **shared)
    return partials, grad_image


def mask_defines(masked: bool) -> Defines:
    """The build-time choices for photos with a mask, or without."""
    return (("MASKED", 1),) if masked else ()


def is_masked(photo: Array) -> bool:
    """Whether a photo uchar[3 or 4, H, W] has a mask."""
    return photo.shape[0] > 3


def loss_value(partials: Array, values: int, ssim_weight: float) -> tuple[float, float, float]:
    """(loss, mean |x - y|, mean SSIM) from partials of `image_loss` over 3 H W values; waits."""
    sums = sum_columns(partials.device, partials)
    l1, ssim = (float(v) / values for v in sums.download())
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), l1, ssim
