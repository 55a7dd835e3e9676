"""Approximations that the render kernels could take, and a device that takes one of them."""

from dataclasses import dataclass

import numpy as np

from clsplat.constants import SPLAT_OPACITY, SPLAT_REALS
from clsplat.device import Device

RENDERING = ("project.cl", "bin.cl", "blend.cl")  # files that read what a variant defines
NO_STEP = 2**24  # alphas below 1 / NO_STEP do not change a float32 transmittance of 1


@dataclass(frozen=True)
class Variant:
    """knob, name: what differs from the default, and how; defines: ((name, value), ...) of the
    kernels; flags: of the compiler; precision: "float" or "double"; half: what is rounded to 16-bit
    floats where it is stored, "splats", "shapes" (splats but for their means) or "sums" (of pairs);
    half_scale: a power of two that sums are multiplied by before and divided by after."""

    knob: str
    name: str
    defines: tuple = ()
    flags: tuple = ()
    precision: str = "float"
    half: str = ""
    half_scale: int = 1

    @property
    def is_timed(self):
        """Rounding to half is done on the host: it shows the error only."""
        return not self.half


DEFAULT = Variant("default", "the default")
DOUBLE = Variant("precision", "double", precision="double")
NO_CUTOFF = Variant("reference", "double without cutoff", precision="double",
                    defines=(("ALPHA_STEPS", NO_STEP),))
NO_STOP = Variant("reference", "double without stop", precision="double",
                  defines=(("TRANSMITTANCE_MIN", 0),))

# knob -> (the default's name, the kind of its error: see `precision.measured`)
KNOBS = {
    "precision": ("float", "rounding"),
    "exponential": ("degree 6, or native_exp where accurate", "rounding"),
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
    Variant("exponential", "native_exp", (("EXP_KIND", 1),)),
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
    """Opens a device's VariantDevices, one for all variants of the same precision and flags: what
    does not differ is built once."""

    def __init__(self, handle, form="auto"):
        self.handle, self.form, self._opened = handle, form, {}

    def __getitem__(self, variant):
        build = variant.precision, variant.flags
        if build not in self._opened:
            self._opened[build] = VariantDevice(self.handle, variant, self.form)
        device = self._opened[build]
        device.variant = variant
        return device


class VariantDevice(Device):
    """A device whose render kernels are built for `variant`, which may be changed among those of
    the same precision and flags.

    depth_keys: uint32[N] of another device's cull, 0 where unseen: splats are blended in the order
    of these.
    """

    def __init__(self, handle, variant, form="auto", depth_keys=None):
        super().__init__(handle, variant.precision, form, build_options=variant.flags)
        self.variant, self.depth_keys = variant, depth_keys

    def launch(self, kernel, defines=(), /, **values):
        half = self.variant.half
        if half == "sums" and kernel.function == "sum_pairs":
            _round_to_half(values["pair_grads"], slice(None), self.variant.half_scale)
        if kernel.file in RENDERING:
            defines += self.variant.defines
        super().launch(kernel, defines, **values)
        if kernel.function == "cull" and self.depth_keys is not None:
            own = values["depth_keys"].download()
            values["depth_keys"].write(np.where(self.depth_keys, self.depth_keys, own))
        if half in ("splats", "shapes") and kernel.function == "project":
            columns = np.arange(0 if half == "splats" else SPLAT_OPACITY, SPLAT_REALS)
            _round_to_half(values["splats"], columns)


def _round_to_half(array, columns, scale=1):
    values = array.download()
    with np.errstate(over="ignore"):  # past 65504 it is infinite, as it would be on the device
        values[:, columns] = (values[:, columns] * scale).astype(np.float16)
        values[:, columns] /= scale
    array.write(values)
