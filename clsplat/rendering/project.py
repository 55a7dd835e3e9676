"""Gaussians to splats, and the adjoint (cl/project.cl)."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import CAMERA_REALS, SPLAT_REALS
from clsplat.device import Array, ArraySpec, Device, Kernel, each
from clsplat.gaussians import LEARNED
from clsplat.rendering.blend import Defines

Rows = Mapping[str, Array]  # field name -> real[N, *row shape]

BORDER = 0.15  # of the photo: so far beyond its borders Jacobians are not clamped
LOW_PASS = 0.3  # pixels squared (Kerbl et al. 2023)

_PARAMETERS = dict(opacity_logits=("real", "N"), log_scales=("real", "N", 3),
                   quaternions=("real", "N", 4))
_COLOURS = dict(sh_constant=("real", "N", 3), sh_rest=("real", "N", "K", 3))
_PLACES = dict(camera=("real", CAMERA_REALS), positions=("real", "N", 3))
CULL = Kernel("project.cl", "cull", each("count"), count="uint", **_PLACES,
              log_scales=("real", "N", 3), quaternions=("real", "N", 4),
              opacity_logits=("real", "N"), depth_keys=("uint", "N"), flags=("uint", "N"))
PROJECT = Kernel("project.cl", "project", each("count"), count="uint",
                 rows=("uint", "V"), **_PLACES, **_COLOURS, **_PARAMETERS,
                 splats=("real", "V", SPLAT_REALS))
_BY_COLOUR = dict(grad_colours=("real", "V", 3), directions=("real", "V", 3))
ADJOINT = Kernel("project.cl", "project_adjoint", each("count"), count="uint", sum_count="uint",
                 rows=("uint", "V"), **_PLACES, **_COLOURS, **_PARAMETERS,
                 sums=("real", "V", "S"),
                 grad_positions=("real", "V", 3), **_BY_COLOUR, grad_opacity_logits=("real", "V"),
                 grad_log_scales=("real", "V", 3), grad_quaternions=("real", "V", 4),
                 grad_means=("real", "V", 2), active=("uint", "V"), skipped=("uint", 1))
HARMONICS = Kernel("project.cl", "harmonics_gradients", each("count"), count="uint", **_BY_COLOUR,
                   grad_sh_constant=("real", "V", 3), grad_sh_rest=("real", "V", "K", 3))
CAMERA = ArraySpec((CAMERA_REALS,))



class FieldGradients(Mapping[str, Array]):
    """Gradients by field, real[V, *row shape]; those by the harmonics are computed when asked for.

    The gradient by a harmonic is the gradient by the colour times the harmonic, so 6 floats of a
    gaussian stand for 48.

    Parameters
    ----------
    device : of the arrays.
    stored : field name -> gradient, without sh_constant and sh_rest.
    grad_colours : real[V, 3], by the colours.
    directions : real[V, 3], unit vectors from the camera.
    harmonics : stored harmonics above the constant, 0, 3, 8 or 15.
    defines : of the build of `project`, for the active degree.
    """

    def __init__(self, device: Device, stored: Mapping[str, Array], grad_colours: Array,
                 directions: Array, harmonics: int, defines: Defines) -> None:
        self.device, self._stored, self.harmonics = device, dict(stored), harmonics
        self.grad_colours, self.directions, self._defines = grad_colours, directions, defines

    def __getitem__(self, name: str) -> Array:
        if name in ("sh_constant", "sh_rest") and name not in self._stored:
            count = len(self.grad_colours)
            constant = self.device.empty((count, 3))
            rest = self.device.empty((count, self.harmonics, 3))
            self.device.launch(HARMONICS, self._defines, count=count,
                               grad_colours=self.grad_colours, directions=self.directions,
                               grad_sh_constant=constant, grad_sh_rest=rest)
            self._stored.update(sh_constant=constant, sh_rest=rest)
        return self._stored[name]

    def __iter__(self) -> Iterator[str]:
        return (field.name for field in LEARNED)

    def __len__(self) -> int:
        return len(LEARNED)


def pack_camera(device: Device, camera: Camera, near: float, low_pass: float = LOW_PASS) -> Array:
    """The camera on the device, as the kernels read it: real[27] (cl/include/camera.h)."""
    return device.upload(np.concatenate([
        camera.rotation.reshape(-1), camera.translation, camera.focal, camera.centre,
        camera.position, [near, low_pass, camera.width, camera.height],
        *clamped_ratios(camera)]))


def clamped_ratios(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(smallest, largest), float64[2] each: the x/z and y/z to which Jacobians are clamped.

    A part of a photo has those of the whole photo, so that both show the same.
    """
    low, high = np.reshape(camera.borders, (2, 2))
    beyond = BORDER * (high - low)
    smallest, largest = ((end - camera.centre) / camera.focal
                         for end in (low - beyond, high + beyond))
    return smallest, largest


def cull(device: Device, rows: Rows, camera: Array, defines: Defines) -> tuple[Array, Array]:
    """Find the gaussians that a packed camera sees.

    Returns
    -------
    uint[N], 1 for those that the image shows, and uint[N], keys that sort them front to back.
    """
    count = len(rows["positions"])
    flags, depth_keys = (device.empty(count, np.uint32) for _ in range(2))
    device.launch(CULL, _of_degree(defines, 0), count=count, camera=camera,
                  positions=rows["positions"], log_scales=rows["log_scales"],
                  quaternions=rows["quaternions"], opacity_logits=rows["opacity_logits"],
                  depth_keys=depth_keys, flags=flags)
    return flags, depth_keys


def project(device: Device, rows: Rows, visible: Array, camera: Array, sh_degree: int,
            defines: Defines) -> Array:
    """The splats real[V, 12] (cl/include/splat.h) of the gaussians `visible` uint[V]."""
    splats = device.empty((len(visible), SPLAT_REALS))
    device.launch(PROJECT, _of_degree(defines, sh_degree), count=len(visible), rows=visible,
                  camera=camera, splats=splats, **_learned(rows))
    return splats


def project_adjoint(device: Device, rows: Rows, visible: Array, camera: Array, sh_degree: int,
                    defines: Defines, splat_grads: Array, skipped: Array
                    ) -> tuple[FieldGradients, Array, Array]:
    """Gradients by the gaussians from gradients by their splats.

    Parameters
    ----------
    device, rows, visible, camera, sh_degree, defines : as they were for `project`.
    splat_grads : real[V, 9 or 10], of `blend_adjoint`.
    skipped : uint[1], to which the number of gradients that are not finite is added.

    Returns
    -------
    The gradients by field; real[V, 2], by the means in pixels; uint[V], the row of each
    gradient, or NO_ROW where it is not finite.
    """
    count, defines = len(visible), _of_degree(defines, sh_degree)
    stored = {f.name: device.empty((count, *rows[f.name].shape[1:])) for f in LEARNED
              if f.name not in ("sh_constant", "sh_rest")}
    grad_colours, directions = device.empty((count, 3)), device.empty((count, 3))
    grad_means, active = device.empty((count, 2)), device.empty(count, np.uint32)
    device.launch(ADJOINT, defines, count=count, sum_count=splat_grads.shape[1], rows=visible,
                  camera=camera, **_learned(rows), sums=splat_grads,
                  **{f"grad_{name}": g for name, g in stored.items()}, grad_colours=grad_colours,
                  directions=directions, grad_means=grad_means, active=active, skipped=skipped)
    gradients = FieldGradients(device, stored, grad_colours, directions,
                               rows["sh_rest"].shape[1], defines)
    return gradients, grad_means, active


def _learned(rows: Rows) -> dict[str, Array]:
    return {field.name: rows[field.name] for field in LEARNED}


def _of_degree(defines: Defines, degree: int) -> Defines:
    """The defines of the build for an active degree of the spherical harmonics."""
    return *defines, ("DEGREE", degree)
