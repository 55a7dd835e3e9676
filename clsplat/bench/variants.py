"""Approximations that the render kernels could use, and a device that uses one of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SPLAT_DEPTH, SPLAT_OPACITY, SPLAT_REALS
from clsplat.device import Array, Device, Handle, Kernel

# files that use the constants of a variant
RENDERING = ("cull.cl", "project.cl", "bin.cl", "blend.cl")
NO_STEP = 2**24  # alphas below 1 / NO_STEP do not change a float32 transmittance of 1


@dataclass(frozen=True)
class Variant:
    """An approximation, or a reference.

    Attributes
    ----------
    knob : the property that differs from the default.
    name : its value.
    defines : constants of the kernels.
    flags : of the OpenCL compiler.
    precision : "float" or "double".
    half : the array that is rounded to 16-bit floats: "splats", "shapes" (splats without their
        means), "sums" (of pairs), or "" for none.
    half_scale : a power of two by which sums are multiplied before and divided after rounding.
    """

    knob: str
    name: str
    defines: tuple[tuple[str, Any], ...] = ()
    flags: tuple[str, ...] = ()
    precision: str = "float"
    half: str = ""
    half_scale: int = 1

    @property
    def is_timed(self) -> bool:
        """False for rounding to half, which the host does, so that it shows the error only."""
        return not self.half


DEFAULT = Variant("default", "the default")
DOUBLE = Variant("precision", "double", precision="double")
NO_CUTOFF = Variant("reference", "double without cutoff", precision="double",
                    defines=(("ALPHA_STEPS", NO_STEP),))
NO_STOP = Variant("reference", "double without stop", precision="double",
                  defines=(("TRANSMITTANCE_MIN", 0),))

# knob -> the default's name, and the kind of its error: see `precision.measured`
KNOBS = {
    "precision": ("float", "rounding"),
    "exponential": ("degree 4 on CPUs, native_exp2 or degree 6 on GPUs", "rounding"),
    "compiler flags": ("none", "rounding"),
    "storage": ("float", "rounding"),
    "alpha cutoff": ("1/255", "no_cutoff"),
    "transmittance stop": ("1e-4", "no_stop"),
    "tiles": ("ellipse", "rounding"),
}
VARIANTS = (
    DEFAULT,
    DOUBLE,
    Variant("exponential", "exp", (("EXP_KIND", 0),)),
    Variant("exponential", "native_exp2", (("EXP_KIND", 1),)),
    *(Variant("exponential", f"degree {degree}", (("EXP_KIND", degree),))
      for degree in (3, 4, 5, 6)),
    *(Variant("compiler flags", flag, flags=(flag,))
      for flag in ("-cl-mad-enable", "-cl-denorms-are-zero", "-cl-fast-relaxed-math")),
    Variant("storage", "splats in half", half="splats"),
    Variant("storage", "splats in half, means in float", half="shapes"),
    Variant("storage", "pair sums in half", half="sums"),
    Variant("storage", "pair sums in half, scaled", half="sums", half_scale=2**20),
    *(Variant("alpha cutoff", f"1/{steps}" if steps < NO_STEP else "none",
              (("ALPHA_STEPS", steps),)) for steps in (128, 512, NO_STEP)),
    *(Variant("transmittance stop", name, (("TRANSMITTANCE_MIN", name),))
      for name in ("1e-2", "1e-3", "0")),
    Variant("tiles", "bounding box", (("BOX_TILES", 1),)),
)


class Devices:
    """The VariantDevices of a device, opened on demand: one for all variants of the same precision
    and flags, so that kernels that do not differ are built once."""

    def __init__(self, handle: Handle, form: str = "auto") -> None:
        self.handle, self.form = handle, form
        self._opened: dict[tuple[str, tuple[str, ...]], VariantDevice] = {}

    def __getitem__(self, variant: Variant) -> VariantDevice:
        build = variant.precision, variant.flags
        if build not in self._opened:
            self._opened[build] = VariantDevice(self.handle, variant, self.form)
        device = self._opened[build]
        device.variant = variant
        return device


class VariantDevice(Device):
    """A device whose render kernels are built for `variant`, which can be replaced by another one
    of the same precision and flags.

    Parameters
    ----------
    depth_keys : uint32[N] of another device's gaussians, 0 where not visible; splats are blended
        in this order.
    """

    def __init__(self, handle: Handle, variant: Variant, form: str = "auto",
                 depth_keys: NDArray[np.uint32] | None = None) -> None:
        super().__init__(handle, variant.precision, form, build_options=variant.flags)
        self.variant, self.depth_keys = variant, depth_keys

    def launch(self, kernel: Kernel, defines: tuple[tuple[str, Any], ...] = (), /,
               **values: Any) -> None:
        """The same as `Device.launch`, with the approximation of the variant."""
        half = self.variant.half
        if half == "sums" and kernel.function == "project_adjoint":
            _round_to_half(values["pair_grads"], slice(None), self.variant.half_scale)
        if kernel.file in RENDERING:
            defines += self.variant.defines
        super().launch(kernel, defines, **values)
        if kernel.function == "project" and self.depth_keys is not None:
            _reorder(self.depth_keys, values["rows"], values["depth_keys"], values["splats"])
        if half in ("splats", "shapes") and kernel.function == "project":
            columns = np.arange(0 if half == "splats" else SPLAT_OPACITY, SPLAT_REALS)
            _round_to_half(values["splats"], columns)


def _reorder(given: NDArray[np.uint32], rows: Array, depth_keys: Array, splats: Array) -> None:
    """Give splats the keys of another device, and depths for the form that sorts by these."""
    given, values = given[rows.download()], splats.download()
    keys = np.where(given, given, depth_keys.download())
    depth_keys.write(keys)
    values[:, SPLAT_DEPTH] = keys.view(np.float32)
    splats.write(values)


def _round_to_half(array: Array, columns: slice | NDArray[np.int64], scale: int = 1) -> None:
    values = array.download()
    with np.errstate(over="ignore"):  # past 65504 it is infinite, as it would be on the device
        values[:, columns] = (values[:, columns] * scale).astype(np.float16)
        values[:, columns] /= scale
    array.write(values)
