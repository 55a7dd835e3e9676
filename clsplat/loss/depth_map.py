"""The rendered depth of a view against a depth map (cl/depth_map.cl), which holds the training."""

from clsplat.device import Array, Device, Forms, Kernel, groups, items
from clsplat.primitives.reduce import sum_columns

_PLANE = ("real", "H", "W")
COMPARE = Kernel(
    "depth_map.cl",
    "compare_depth",
    Forms(item=items("H"), group=groups("H", "SCAN_GROUP")),
    width="int",
    height="int",
    weight="real",
    depth=_PLANE,
    transmittance=_PLANE,
    map=_PLANE,
    grad_depth=_PLANE,
    grad_transmittance=_PLANE,
    partials=("real", "H", 2),
)


def compare_depth(
    device: Device, depth: Array, transmittance: Array, known: Array, weight: float
) -> tuple[Array, Array, Array]:
    """The difference of a view's rendered depth from a depth map, and its gradients.

    `known` is real[H, W], depths along the camera's axis, world units; 0: unknown. Returns real[2],
    the sum of the relative errors and the number of pixels that count; then the gradients of the
    loss by depth and by transmittance, real[H, W] each.
    """
    height, width = depth.shape
    grads = dict(grad_depth=device.empty(depth.shape), grad_transmittance=device.empty(depth.shape))
    partials = device.empty((height, 2))
    device.launch(
        COMPARE,
        width=width,
        height=height,
        weight=weight,
        depth=depth,
        transmittance=transmittance,
        map=known,
        **grads,
        partials=partials,
    )
    return sum_columns(device, partials), grads["grad_depth"], grads["grad_transmittance"]
