"""Time variants of the group form of blending and its adjoint, on the city of the benchmarks.

    python -m tools.studies.blend_variants [--device auto] [--gaussians 200k,1M,4M] [--only NAME]

Prints the median time on the device of each kernel, and how far the image and the sums of splats
are from those of the first variant. Variants are timed in turns, so that other work on the machine
disturbs all of them alike. A tree that lacks a variant's switch gives the same time as without it,
so an older tree is compared by running this file with --only default there.
"""

import argparse
from dataclasses import dataclass, field

import numpy as np

from clsplat.bench.measure import counts
from clsplat.bench.workloads import city
from clsplat.device import choose_device
from clsplat.rendering.blend import blend, blend_adjoint, blend_defines
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import project_defines, sum_pairs

KERNELS = "blend", "blend_adjoint"


@dataclass
class Variant:
    """Build-time choices: attributes of the device, and constants of the kernels."""

    sizes: dict[str, int] = field(default_factory=dict)
    defines: tuple[tuple[str, int], ...] = ()


VARIANTS = {
    "default": Variant(),
    "no sub-tile masks": Variant(defines=(("SUBTILE_MASK", 0),)),
    "a row of sub-tiles at once": Variant(defines=(("ROWS_AT_ONCE", 1),)),
    "four rows": Variant(defines=(("ROWS_AT_ONCE", 4),)),
    "division as it is": Variant(defines=(("NATIVE_DIVIDE", 0),)),
    "sums of 1 splat": Variant(defines=(("TOGETHER", 1),)),
    "sums of 2 splats": Variant(defines=(("TOGETHER", 2),)),
    "buckets of 32": Variant({"bucket": 32}),
    "buckets of 64": Variant({"bucket": 64}),
    "buckets of 128": Variant({"bucket": 128}),
    "64 lanes": Variant({"adjoint_group": 64}),
    "64 lanes, sums of 7": Variant({"adjoint_group": 64}, (("TOGETHER", 7),)),
    "64 lanes, buckets of 128": Variant({"adjoint_group": 64, "bucket": 128}),
    "128 lanes": Variant({"adjoint_group": 128, "bucket": 128}),
    "sub-tiles of 64": Variant({"wave": 64, "adjoint_group": 64}),
}


class Case:
    """A frame of a variant, and its adjoint."""

    def __init__(self, device, variant, rows, camera):
        self.device, self.variant = device, variant
        self.choose()
        self.renderer = Renderer(device, 3, near=0.01)
        packed = self.renderer.pack(camera)
        self.frame = self.renderer.render(rows, packed, camera.width, camera.height, 3)
        self.defines = blend_defines(False) + variant.defines
        shape = (3, camera.height, camera.width)
        self.grad = device.upload(np.random.default_rng(0).normal(size=shape) / np.prod(shape))

    def choose(self):
        """Give the device the sizes of the variant."""
        for name, value in {**DEFAULT_SIZES, **self.variant.sizes}.items():
            setattr(self.device, name, value)

    def run(self):
        """Image real[3, H, W] and sums real[V, 9]."""
        self.choose()
        frame, background = self.frame, self.renderer.background
        blended = blend(self.device, frame.splats, frame.pairs, *frame.size, background,
                        self.defines)
        splat_grads = blend_adjoint(self.device, frame.splats, frame.pairs, blended, background,
                                    self.grad, blended.depth, blended.depth, self.defines)
        return blended.image, sum_pairs(self.device, splat_grads, frame.counts,
                                        project_defines(0, False))


DEFAULT_SIZES: dict[str, int] = {}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--gaussians", default="200k,1M,4M", type=counts)
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    device = choose_device(options.device, form="group", profiling=True)
    DEFAULT_SIZES.update({name: getattr(device, name)
                          for name in ("wave", "bucket", "adjoint_group") if hasattr(device, name)})
    print(f"{device.name}, {DEFAULT_SIZES}")
    for count in options.gaussians:
        gaussians, (camera, *_) = city(count)
        rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
        cases = {name: Case(device, VARIANTS[name], rows, camera) for name in options.only}
        results = {name: [array.download() for array in case.run()]
                   for name, case in cases.items()}  # the first run compiles
        first = next(iter(results.values()))
        times = {name: {kernel: [] for kernel in KERNELS} for name in cases}
        for _ in range(options.repeats):
            for name, case in cases.items():
                with device.profile() as launches:
                    case.run()
                for kernel in KERNELS:
                    times[name][kernel] += launches[kernel]
        pairs = next(iter(cases.values())).frame.pairs.count
        print(f"\n{count:,} gaussians, {camera.width} x {camera.height}, {pairs:,} pairs\n"
              f"{'ms':28}" + "".join(f"{kernel:>15}" for kernel in KERNELS)
              + "     image    sums")
        for name in cases:
            medians = [1e3 * np.median(times[name][kernel]) for kernel in KERNELS]
            off = [np.abs(mine - its).max() / np.abs(its).max()
                   for mine, its in zip(results[name], first)]
            print(f"{name:28}" + "".join(f"{each:15.4f}" for each in medians)
                  + "".join(f"{each:10.1e}" for each in off), flush=True)


if __name__ == "__main__":
    main()
