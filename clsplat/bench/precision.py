"""Error against run time: the render kernels under every approximation that they could use.

A frame of the aerial city is rendered and differentiated by each variant (`variants.py`). Errors
are those of image and gradients against double builds, times those of forward and adjoint without a
loss. --html and --markdown write a page; --records reads the lines that earlier runs printed with
--json instead of measuring, so that a page can show several machines.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import NO_ROW, SPLAT_DEPTH
from clsplat.device import choose_device
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.rendering import pipeline
from clsplat.rendering.pipeline import Gradients, Renderer

from .measure import arguments
from .numerics import gradient_error, html, markdown
from .timing import in_turn, spread
from .variants import (
    DEFAULT,
    DOUBLE,
    KNOBS,
    NO_CUTOFF,
    NO_STOP,
    VARIANTS,
    Devices,
    VariantDevice,
)
from .workloads import city

VISIBLE_ERROR = 1e-4  # of an image value
Scene = tuple[Gaussians, Sequence[Camera]]


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    options = arguments(argv, __doc__, gaussians="50k", size=[512, 384], repeats=15, html="",
                        markdown="", records=[""])
    records = []
    if any(options.records):
        for path in options.records:
            records += [json.loads(line) for line in Path(path).read_text("utf-8").splitlines()]
    else:
        for spec in options.device.split(","):
            for count in options.gaussians:
                for record in measured(spec, options.form, city(count, tuple(options.size)),
                                       options.repeats):
                    record["command"] = f"clsplat bench precision {' '.join(argv)}".strip()
                    records.append(record)
                    print(json.dumps(record) if options.json else line(record), flush=True)
    for path, write in ((options.html, html), (options.markdown, markdown)):
        if path:
            Path(path).write_text(write(records), "utf-8")


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
    references = {"rounding": Frame(devices[DOUBLE], scene).result(),
                  "same_order": Frame(in_this_order, scene).result(),
                  "no_cutoff": Frame(devices[NO_CUTOFF], scene).result(),
                  "no_stop": Frame(devices[NO_STOP], scene).result()}
    frames = {variant: Frame(devices[variant], scene) for variant in VARIANTS if variant.is_timed}
    times = dict(zip(frames, map(spread, in_turn(
        [(frame.device, frame.run) for frame in frames.values()], repeats))))
    for variant in VARIANTS:
        frame = frames.get(variant) or Frame(devices[variant], scene)
        result = frame.result()
        gaussians, (camera, *_) = scene
        yield {"family": "precision", "knob": variant.knob, "variant": variant.name,
               "form": frame.device.form, "device": frame.device.name,
               "platform": handle.platform.name.strip(), "driver": handle.driver_version,
               "size": {"gaussians": gaussians.count, "width": camera.width,
                        "height": camera.height, "skipped": result["skipped"]},
               **times.get(variant, {}), **{kind: errors(result, reference)
                           for kind, reference in references.items()}}


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
        self.grad = device.upload(
            np.random.default_rng(0).normal(0, 1 / np.prod(shape), shape).astype(np.float32))

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
        return {"image": frame.image.download().astype(np.float64), "gradients": full,
                "skipped": int((~finite).sum())}


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
            "element": f"{name}[{', '.join(map(str, place))}]"}
    return {"image_max": float(image.max()), "image_mean": float(image.mean()),
            "image_above": float((image > VISIBLE_ERROR).mean()), "gradients": gradients}


def line(record: dict[str, Any]) -> str:
    """A record as a line of a table, with the worst of the gradients for each kind of error."""
    time = f"{record['median_ms']:9.2f} ms" if "median_ms" in record else f"{'-':>12}"
    kinds = dict.fromkeys(("rounding", KNOBS.get(record["knob"], ("", "no_cutoff"))[1]))
    texts = [f"{kind}: image {record[kind]['image_max']:.1e}, mean {record[kind]['image_mean']:.1e}"
             f", gradients {gradient_error(record, kind):.1e}" for kind in kinds]
    return f"{record['knob']:18} {record['variant']:30} {time}  {'; '.join(texts)}"
