"""Error against run time: the render kernels under every approximation that they could use.

    python -m tools.studies.precision [--device auto] [--gaussians 50k] [--json]

A frame of the aerial city is rendered and differentiated by each variant. Errors are those of image
and gradients against double builds, times those of forward and adjoint without a loss. It prints a
table, or JSON lines.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import NO_ROW, SPLAT_DEPTH, SPLAT_OPACITY, SPLAT_REALS
from clsplat.device import Array, Device, Handle, Kernel, choose_device
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.rendering import pipeline
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import Gradients
from tools.bench.report import counts
from tools.bench.timing import in_turn, spread
from tools.bench.workloads import city

VISIBLE_ERROR = 1e-4  # of an image value
Scene = tuple[Gaussians, Sequence[Camera]]

# files that use the constants of a variant
RENDERING = ("cull.cl", "project.cl", "bin.cl", "blend.cl")
NO_STEP = 2**24  # alphas below 1 / NO_STEP do not change a float32 transmittance of 1


@dataclass(frozen=True)
class Variant:
    """An approximation, or a reference."""

    knob: str  # the property that differs from the default
    name: str  # its value
    defines: tuple[tuple[str, Any], ...] = ()  # constants of the kernels
    flags: tuple[str, ...] = ()  # of the OpenCL compiler
    precision: str = "float"  # or "double"
    # the array that is rounded to 16-bit floats: "splats", "shapes" (splats without their means),
    # "sums" (of pairs), or "" for none
    half: str = ""
    # a power of two by which sums are multiplied before and divided after rounding
    half_scale: int = 1

    @property
    def is_timed(self) -> bool:
        """False for rounding to half, which the host does, so that it shows the error only."""
        return not self.half


DEFAULT = Variant("default", "the default")
DOUBLE = Variant("precision", "double", precision="double")
NO_CUTOFF = Variant("reference", "double without cutoff", precision="double", defines=(("ALPHA_STEPS", NO_STEP),))
NO_STOP = Variant("reference", "double without stop", precision="double", defines=(("TRANSMITTANCE_MIN", 0),))

# knob -> the default's name, and the kind of its error: see `measured`
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
    *(Variant("exponential", f"degree {degree}", (("EXP_KIND", degree),)) for degree in (3, 4, 5, 6)),
    *(
        Variant("compiler flags", flag, flags=(flag,))
        for flag in ("-cl-mad-enable", "-cl-denorms-are-zero", "-cl-fast-relaxed-math")
    ),
    Variant("storage", "splats in half", half="splats"),
    Variant("storage", "splats in half, means in float", half="shapes"),
    Variant("storage", "pair sums in half", half="sums"),
    Variant("storage", "pair sums in half, scaled", half="sums", half_scale=2**20),
    *(
        Variant("alpha cutoff", f"1/{steps}" if steps < NO_STEP else "none", (("ALPHA_STEPS", steps),))
        for steps in (128, 512, NO_STEP)
    ),
    *(Variant("transmittance stop", name, (("TRANSMITTANCE_MIN", name),)) for name in ("1e-2", "1e-3", "0")),
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

    def __init__(
        self, handle: Handle, variant: Variant, form: str = "auto", depth_keys: NDArray[np.uint32] | None = None
    ) -> None:
        super().__init__(handle, variant.precision, form, build_options=variant.flags)
        self.variant, self.depth_keys = variant, depth_keys

    def launch(self, kernel: Kernel, defines: tuple[tuple[str, Any], ...] = (), /, **values: Any) -> None:
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


def measured(spec: str, form: str, scene: Scene, repeats: int) -> Iterator[dict[str, Any]]:
    """A record for each of `VARIANTS`, on the device of `choose_device(spec)`.

    A record has the fields of a benchmark's line except `bytes` and `operations`, and the `errors`
    against double builds: `rounding`, of the same sum; `same_order`, in the order that
    single-precision depths give; `no_cutoff` and `no_stop`, without the alpha cutoff or the
    transmittance stop.
    """
    handle = choose_device(spec).handle
    devices = Devices(handle, form)
    in_this_order = VariantDevice(handle, DOUBLE, form, Frame(devices[DEFAULT], scene).depth_keys())
    references = {
        "rounding": Frame(devices[DOUBLE], scene).result(),
        "same_order": Frame(in_this_order, scene).result(),
        "no_cutoff": Frame(devices[NO_CUTOFF], scene).result(),
        "no_stop": Frame(devices[NO_STOP], scene).result(),
    }
    frames = {variant: Frame(devices[variant], scene) for variant in VARIANTS if variant.is_timed}
    times = dict(zip(frames, map(spread, in_turn([(frame.device, frame.run) for frame in frames.values()], repeats))))
    for variant in VARIANTS:
        frame = frames.get(variant) or Frame(devices[variant], scene)
        result = frame.result()
        gaussians, (camera, *_) = scene
        yield {
            "family": "precision",
            "knob": variant.knob,
            "variant": variant.name,
            "form": frame.device.form,
            "device": frame.device.name,
            "platform": handle.platform.name.strip(),
            "driver": handle.driver_version,
            "size": {
                "gaussians": gaussians.count,
                "width": camera.width,
                "height": camera.height,
                "skipped": result["skipped"],
            },
            **times.get(variant, {}),
            **{kind: errors(result, reference) for kind, reference in references.items()},
        }


class Frame:
    """The scene's first view, rendered and differentiated in a variant."""

    def __init__(self, device: VariantDevice, scene: Scene) -> None:
        gaussians, (camera, *_) = scene
        self.device, self.count = device, gaussians.count
        self.variant = device.variant  # frames of several variants share the device
        self.renderer = Renderer(device, gaussians.sh_degree, near=0.01)
        self.rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
        self.camera, self.size = self.renderer.pack(camera), (camera.width, camera.height)
        # of random sign, so that sums cancel as they do late in training; as small as a mean's
        shape = (3, camera.height, camera.width)
        self.grad = device.upload(np.random.default_rng(0).normal(0, 1 / np.prod(shape), shape).astype(np.float32))

    def depth_keys(self) -> NDArray[np.uint32]:
        """The keys uint32[N] by which the gaussians are ordered, 0 for those not visible."""
        frame, _ = self.run()
        keys = np.zeros(self.count, np.uint32)
        depths = frame.splats.download()[:, SPLAT_DEPTH].astype(np.float32)
        keys[frame.visible.download()] = depths.view(np.uint32)
        return keys

    def run(self) -> tuple[pipeline.Frame, Gradients]:
        """Render the view and take the gradients."""
        self.device.variant = self.variant
        frame = self.renderer.render(self.rows, self.camera, *self.size, sh_degree=3)
        return frame, self.renderer.adjoint(self.rows, frame, self.grad)

    def result(self) -> dict[str, Any]:
        """The image and the gradients on the host.

        Returns
        -------
        image : float64[3, H, W]
        gradients : float64[N, ...] by the name of the field, zero for gaussians not visible.
        skipped : the number of rows whose gradients were not finite.
        """
        frame, gradients = self.run()
        visible = gradients.rows.download()
        finite = visible != NO_ROW
        full = {}
        for field in LEARNED:
            values = gradients.fields[field.name].download()
            full[field.name] = np.zeros((self.count, *values.shape[1:]))
            full[field.name][visible[finite]] = values[finite]
        return {"image": frame.image.download().astype(np.float64), "gradients": full, "skipped": int((~finite).sum())}


def errors(result: dict[str, Any], reference: dict[str, Any]) -> dict[str, Any]:
    """The difference of a `Frame.result` from a reference.

    Returns
    -------
    image_max, image_mean : of the absolute difference.
    image_above : the share of values that differ by more than 1e-4.
    gradients : by the name of the field; `l2`, the norm of the difference over that of the
        reference; `worst`, the largest difference over the largest element of the reference;
        `element`, where it is.
    """
    image = np.abs(result["image"] - reference["image"])
    gradients = {}
    for name, expected in reference["gradients"].items():
        off = np.abs(result["gradients"][name] - expected)
        place = np.unravel_index(off.argmax(), off.shape)
        gradients[name] = {
            "l2": float(np.linalg.norm(off) / np.linalg.norm(expected)),
            "worst": float(off[place] / np.abs(expected).max()),
            "element": f"{name}[{', '.join(map(str, place))}]",
        }
    return {
        "image_max": float(image.max()),
        "image_mean": float(image.mean()),
        "image_above": float((image > VISIBLE_ERROR).mean()),
        "gradients": gradients,
    }


def gradient_error(record: dict[str, Any], kind: str) -> float:
    """The largest L2 error of a gradient."""
    return max(float(gradient["l2"]) for gradient in record[kind]["gradients"].values())


def line(record: dict[str, Any]) -> str:
    """A record as a line of a table, with the worst of the gradients for each kind of error."""
    time = f"{record['median_ms']:9.2f} ms" if "median_ms" in record else f"{'-':>12}"
    kinds = dict.fromkeys(("rounding", KNOBS.get(record["knob"], ("", "no_cutoff"))[1]))
    texts = [
        f"{kind}: image {record[kind]['image_max']:.1e}, mean {record[kind]['image_mean']:.1e}"
        f", gradients {gradient_error(record, kind):.1e}"
        for kind in kinds
    ]
    return f"{record['knob']:18} {record['variant']:30} {time}  {'; '.join(texts)}"


def main() -> None:
    """Print the records of all variants."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--form", default="auto")
    parser.add_argument("--gaussians", type=counts, default="50k")
    parser.add_argument("--size", type=int, nargs=2, default=(512, 384))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    for spec in options.device.split(","):
        for count in options.gaussians:
            for record in measured(spec, options.form, city(count, tuple(options.size)), options.repeats):
                print(json.dumps(record) if options.json else line(record), flush=True)


if __name__ == "__main__":
    main()
