"""Where the rays of pixels pass the gaussians at which the light falls to a given share
(cl/ray_depth.cl)."""

from clsplat.constants import CAMERA_REALS, SPLAT_REALS
from clsplat.device import Array, Device, Kernel, each
from clsplat.rendering.blend import Defines
from clsplat.rendering.project import Rows

MOST_NUMBERED = 1 << 24  # splats whose numbers float32 holds

NUMBER = Kernel("ray_depth.cl", "number_splats", each("count"), count="uint", splats=("real", "V", SPLAT_REALS))
RAY_DEPTH = Kernel(
    "ray_depth.cl",
    "ray_depth",
    each("width height"),
    width="int",
    height="int",
    rows=("uint", "V"),
    camera=("real", CAMERA_REALS),
    positions=("real", "N", 3),
    opacity_logits=("real", "N"),
    log_scales=("real", "N", 3),
    quaternions=("real", "N", 4),
    depth=("real", "H", "W"),
)


def number_splats(device: Device, splats: Array, defines: Defines) -> Array:
    """A copy of splats with the number of each, from 1, in place of its depth; `defines` are of
    `project`."""
    numbered = splats.copied()
    device.launch(NUMBER, defines, count=len(splats), splats=numbered)
    return numbered


def ray_depth(device: Device, rows: Rows, visible: Array, camera: Array, depth: Array, defines: Defines) -> None:
    """Turn numbers of splats into the depths at which the rays of pixels pass their gaussians.

    Parameters
    ----------
    rows : the parameters.
    visible : uint[V], the row of each splat.
    camera : real[27], packed.
    depth : real[H, W], numbers from 1; 0, where there is none, stays.
    defines : as of `project`.
    """
    height, width = depth.shape
    device.launch(
        RAY_DEPTH,
        defines,
        width=width,
        height=height,
        rows=visible,
        camera=camera,
        positions=rows["positions"],
        opacity_logits=rows["opacity_logits"],
        log_scales=rows["log_scales"],
        quaternions=rows["quaternions"],
        depth=depth,
    )
