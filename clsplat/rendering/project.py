"""Gaussians to splats, and the adjoint (cl/project.cl)."""

import numpy as np

from clsplat.constants import CAMERA_REALS, SPLAT_REALS
from clsplat.device import ArraySpec, Kernel, each
from clsplat.gaussians import LEARNED

BORDER = 0.15  # of the photo, beyond its borders: how far a Jacobian follows
LOW_PASS = 0.3  # pixels squared (Kerbl et al. 2023)

_PARAMETERS = dict(opacity_logits=("real", "N"), log_scales=("real", "N", 3),
                   quaternions=("real", "N", 4))
_COLOURS = dict(sh_constant=("real", "N", 3), sh_rest=("real", "N", "K", 3))
_PLACES = dict(camera=("real", CAMERA_REALS), positions=("real", "N", 3))
CULL = Kernel("project.cl", "cull", each("count"), count="uint", **_PLACES,
              log_scales=("real", "N", 3), quaternions=("real", "N", 4),
              opacity_logits=("real", "N"), depth_keys=("uint", "N"), flags=("uint", "N"))
PROJECT = Kernel("project.cl", "project", each("count"), count="uint", degree="uint",
                 rows=("uint", "V"), **_PLACES, **_COLOURS, **_PARAMETERS,
                 splats=("real", "V", SPLAT_REALS))
ADJOINT = Kernel("project.cl", "project_adjoint", each("count"), count="uint", degree="uint",
                 sum_count="uint", rows=("uint", "V"), **_PLACES, **_COLOURS, **_PARAMETERS,
                 sums=("real", "V", "S"),
                 grad_positions=("real", "V", 3), grad_sh_constant=("real", "V", 3),
                 grad_sh_rest=("real", "V", "K", 3), grad_opacity_logits=("real", "V"),
                 grad_log_scales=("real", "V", 3), grad_quaternions=("real", "V", 4),
                 grad_means=("real", "V", 2), active=("uint", "V"), skipped=("uint", 1))


CAMERA = ArraySpec((CAMERA_REALS,))


def pack_camera(device, camera, near, low_pass=LOW_PASS):
    """The camera as the kernels read it (cl/include/camera.h), on the device."""
    return device.upload(np.concatenate([
        camera.rotation.reshape(-1), camera.translation, camera.focal, camera.centre,
        camera.position, [near, low_pass, camera.width, camera.height],
        *clamped_ratios(camera)]))


def clamped_ratios(camera):
    """(lowest, highest): float64[2] each, x/z and y/z to which Jacobians are clamped. A part of a
    photo has those of the whole, so that it shows the same."""
    low, high = np.reshape(camera.borders, (2, 2))
    beyond = BORDER * (high - low)
    return tuple((end - camera.centre) / camera.focal for end in (low - beyond, high + beyond))


def cull(device, rows, camera, defines):
    """(flags uint[N], depth keys uint[N]): which gaussians meet the image, and their order."""
    count = len(rows["positions"])
    flags, depth_keys = (device.empty(count, np.uint32) for _ in range(2))
    device.launch(CULL, defines, count=count, camera=camera, positions=rows["positions"],
                  log_scales=rows["log_scales"], quaternions=rows["quaternions"],
                  opacity_logits=rows["opacity_logits"], depth_keys=depth_keys, flags=flags)
    return flags, depth_keys


def project(device, rows, visible, camera, degree, defines):
    """splats real[V, 12] (cl/include/splat.h) of the gaussians `visible` uint[V]."""
    splats = device.empty((len(visible), SPLAT_REALS))
    device.launch(PROJECT, defines, count=len(visible), degree=degree, rows=visible, camera=camera,
                  splats=splats, **_learned(rows))
    return splats


def project_adjoint(device, rows, visible, camera, degree, defines, sums, skipped):
    """Gradients by field name, real[V, *row shape]; the pixel gradient of the means real[V, 2];
    and active uint[V], the row of each gradient, or NO_ROW where it was not finite.

    sums: real[V, S], each splat's sums from the blend adjoint. skipped: uint[1], counts the latter.
    """
    count = len(visible)
    gradients = {f.name: device.empty((count, *rows[f.name].shape[1:])) for f in LEARNED}
    grad_means, active = device.empty((count, 2)), device.empty(count, np.uint32)
    device.launch(ADJOINT, defines, count=count, degree=degree, sum_count=sums.shape[1],
                  rows=visible, camera=camera, **_learned(rows), sums=sums,
                  **{f"grad_{name}": g for name, g in gradients.items()},
                  grad_means=grad_means, active=active, skipped=skipped)
    return gradients, grad_means, active


def _learned(rows):
    """Without what is only carried along."""
    return {field.name: rows[field.name] for field in LEARNED}
