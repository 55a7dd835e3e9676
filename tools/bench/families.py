"""The benchmarks of single kernel families, on the first view of the made city; those that compare
photos are in photo_families.py.

A family is a function that gives what to time, by the name of the variant.
"""

import itertools
from collections.abc import Callable
from functools import partial

import numpy as np

from clsplat.cities import choose as choosing
from clsplat.constants import CATCH_UP_EVERY, LAZY_TERMS, PAGE_ROWS, POSE_REALS
from clsplat.gaussians import LEARNED
from clsplat.loss.depth_map import compare_depth
from clsplat.loss.exposure import Exposures
from clsplat.loss.image_loss import image_loss as loss_and_gradient
from clsplat.loss.regularise import regularise as regularise_rows
from clsplat.optimise.adam import DeviceAdam
from clsplat.optimise.batch import BatchMean
from clsplat.optimise.noise import add_noise
from clsplat.optimise.page_store import PageStore
from clsplat.optimise.pages import Pages
from clsplat.optimise.pose import RATE, Poses
from clsplat.partition.region import Region, Space
from clsplat.primitives import compact as compacting
from clsplat.primitives import gather as gathering
from clsplat.primitives.compact import new_counts
from clsplat.primitives.reduce import sum_columns
from clsplat.primitives.sort import stable_sort
from clsplat.rendering import blend as blending
from clsplat.rendering import project as projection
from clsplat.rendering import ray_depth as along_rays
from clsplat.rendering.bin import bin_splats
from clsplat.rendering.contribution import contribution as contributions
from clsplat.rendering.cull import cull as cull_rows
from clsplat.rendering.project import pack_camera
from clsplat.response import Lenses
from clsplat.scene import Scene, View
from clsplat.training.frequency import scene_frequency
from tools.bench.photo_families import match, reproject, sift, signed_distance, sweep
from tools.bench.report import Bench, Cases
from tools.bench.workloads import DEFINES, CityFrame, ring_camera
from tools.bench.workloads import city as made_city

DEGREE = 3
RATES = {field.name: field.rate for field in LEARNED}


def adam(city: CityFrame) -> Cases:
    """A step, and how rows that a view sees catch up with 20 steps that they missed."""
    gradients, counts = city.gradients(), new_counts(city.device)
    engine, lazy = (DeviceAdam(city.device, city.rows) for _ in range(2))
    # sums by which rows catch up, not zero
    sums = np.full((CATCH_UP_EVERY, LAZY_TERMS), 1e-9)
    lazy.load_lag({**lazy.lag(), "coefficients": sums}, 0)

    def catch_up() -> None:
        lazy.steps, lazy.is_current = lazy.steps + 20, False
        lazy.catch_up_seen(city.rows, lazy.numbers(lazy.steps + 1, RATES), 3, None, city.camera, counts)

    return {"step": partial(engine.apply, city.rows, gradients, engine.numbers(1, RATES), DEGREE), "catch up": catch_up}


def batch(city: CityFrame) -> Cases:
    """The mean of the gradients of four views, here of the same view."""
    gradients, counts = city.gradients(), new_counts(city.device)
    sums = BatchMean(city.device, {field.name: city.rows[field.name] for field in LEARNED}, 4)

    def mean() -> None:
        for _ in range(sums.views):
            sums.add(gradients, DEGREE)
        sums.mean(counts, DEGREE, sums.count)

    return {"mean of 4": mean}


def bin(city: CityFrame) -> Cases:
    """From splats to the pairs of every tile, in depth order."""
    frame = city.frame
    return {
        "splats to pairs": partial(
            bin_splats, city.device, frame.splats, frame.counts, frame.order, *frame.size, room=city.pairs.count
        )
    }


def blend(city: CityFrame) -> Cases:
    """Blending a frame's splats, and its adjoint."""
    device, frame, background = city.device, city.frame, city.renderer.background
    cases: dict[str, Callable[[], object]] = {}
    for depth in (False, True):
        defines, name = blending.blend_defines(depth), " with depth" * depth
        forward = partial(blending.blend, device, frame.splats, city.pairs, *frame.size, background, defines)
        blended = forward()
        # any gradients will do: their values do not change the work
        cases |= {
            "forward" + name: forward,
            "adjoint" + name: partial(
                blending.blend_adjoint,
                device,
                frame.splats,
                city.pairs,
                blended,
                background,
                blended.image,
                blended.depth_channel,
                blended.depth_channel,
                defines,
            ),
        }
    return cases


def compact(city: CityFrame) -> Cases:
    """The list of a frame's visible gaussians from their flags."""
    flags, totals = cull_rows(city.device, city.rows, city.camera, DEFINES)
    kept = partial(compacting.compact, city.device, flags, new_counts(city.device), city.seen)
    return {"totals from culling": partial(kept, totals), "with its totals": kept}


def contribution(city: CityFrame) -> Cases:
    """The contribution of each splat of a frame."""
    weights = city.device.upload(city.plane())
    return {"all splats": partial(contributions, city.device, city.frame, weights)}


def cull(city: CityFrame) -> Cases:
    """Which gaussians a view sees."""
    return {"all gaussians": partial(cull_rows, city.device, city.rows, city.camera, DEFINES)}


def depth_map(city: CityFrame) -> Cases:
    """A rendered depth against a depth map."""
    depth, known = (city.device.upload(125 + 3 * city.plane(seed)) for seed in (0, 1))
    return {
        "value and gradient": partial(compare_depth, city.device, depth, city.frame.blended.transmittance, known, 1.0)
    }


def exposure(city: CityFrame) -> Cases:
    """The adjoint of a view's response and its step."""
    grad, counts = city.device.upload(city.plane(0, 3)), new_counts(city.device)
    camera = ring_camera(0, city.frame.size)
    packed, lenses = pack_camera(city.device, camera, 0.01), Lenses.of_cameras(100 * [camera])

    def both(exposures: Exposures) -> None:
        exposures.step(0, exposures.adjoint(0, packed, city.frame.image, grad)[1], counts)

    return {
        "adjoint and step": partial(both, Exposures(city.device, 100)),
        "with vignetting": partial(both, Exposures(city.device, 100, lenses=lenses)),
    }


def frequency(city: CityFrame) -> Cases:
    """The nine scene frequencies of the city, including their download."""
    return {
        "nine values": partial(
            scene_frequency, city.device, {name: city.rows[name] for name in ("log_scales", "opacity_logits")}
        )
    }


def choose(city: CityFrame) -> Cases:
    """Which gaussians a region in the middle does not reach, and their sizes in 24 views."""
    gaussians, cameras = made_city(city.count)
    views = tuple(View(str(number), camera, b"") for number, camera in enumerate(cameras[:24]))
    scene = Scene("city", views, np.zeros((1, 3)), np.zeros((1, 3), np.uint8), np.zeros(3))
    middle, half = gaussians.positions.mean(axis=0), np.ptp(gaussians.positions, axis=0) / 8
    region = Region(Space(np.eye(3), middle, half), np.full(3, -1.0), np.ones(3), 0.1)
    outside = city.device.zeros(city.count, np.uint32)
    return {
        "outside": partial(
            choosing.note_outside, city.device, scene, region, city.rows["positions"], city.rows["log_scales"], outside
        ),
        "sizes, from the host": partial(
            choosing.find_sizes, city.device, gaussians.positions, gaussians.log_scales, scene, region, views
        ),
    }


def gather(city: CityFrame) -> Cases:
    """The rows of a frame's visible gaussians, in its order."""
    device, visible, rows = city.device, city.frame.visible, city.rows["sh_rest"]
    gathered = gathering.gather(device, rows, visible)
    return {"gather": partial(gathering.gather, device, rows, visible, gathered)}


def image_loss(city: CityFrame) -> Cases:
    """L1 and D-SSIM with the gradient."""
    photo = city.device.upload((255 * city.plane(0, 3)).astype(np.uint8))
    return {"value and gradient": partial(loss_and_gradient, city.device, city.frame.image, photo, 0.2)}


def noise(city: CityFrame) -> Cases:
    """Random steps of the positions of a model that is transparent."""
    city.rows["opacity_logits"].fill(-9)
    return {"all move": partial(add_noise, city.rows, 1e-6, 1, 0, new_counts(city.device))}


def pages(city: CityFrame) -> Cases:
    """Harmonics of gaussians of which a fifth fits the device: a view's pages marked, and twenty
    pages that come while as many leave."""
    count = 100 * PAGE_ROWS
    rng, fifths = np.random.default_rng(0), np.arange(100) // 20 % 5
    store = PageStore(rng.random((count, 3)), {"sh_rest": np.zeros((count, 45), np.float32)})
    paged = Pages(city.device, store, lambda: 20 * store.page_bytes)
    flags = city.device.upload(np.arange(count, dtype=np.uint32) % 7 == 0, np.uint32)
    turns = itertools.cycle(range(5))

    def exchange() -> None:
        paged.fetch(fifths == next(turns))
        paged.note_change()
        city.device.finish()

    exchange()
    return {"mark": partial(paged.mark, flags), "exchange": exchange}


def pose(city: CityFrame) -> Cases:
    """The corrected camera of a view and a step on its pose, by the gradients of all gaussians."""
    device = city.device
    poses = Poses(device, 100 * [ring_camera(0, city.frame.size)], 1.0)
    terms = device.upload(np.random.default_rng(0).normal(size=(city.count, POSE_REALS)))
    counts = new_counts(device, city.count)

    def both() -> None:
        poses.apply(0, city.camera)
        poses.step(0, RATE, city.camera, terms, counts)

    return {"camera and step": both}


def project(city: CityFrame) -> Cases:
    """Projection and its adjoint, all spherical harmonics active."""
    device, frame = city.device, city.frame
    splat_grads = blending.blend_adjoint(
        device,
        frame.splats,
        city.pairs,
        frame.blended,
        city.renderer.background,
        frame.image,
        None,
        None,
        blending.blend_defines(with_depth=False),
    )
    inputs = device, city.rows, frame.visible, frame.counts, city.camera, 3, DEFINES
    return {
        "project": partial(projection.project, *inputs),
        "adjoint": partial(projection.project_adjoint, *inputs, splat_grads, city.renderer.skipped),
    }


def reduce(city: CityFrame) -> Cases:
    """The sum of one value for each gaussian."""
    rows = city.rows["opacity_logits"].reshaped(city.count, 1)
    return {"gaussians": partial(sum_columns, city.device, rows)}


def regularise(city: CityFrame) -> Cases:
    """Regularisation of the opacities and sizes of the gaussians that a view sees."""
    return {"of a view": partial(regularise_rows, city.rows, city.gradients(), 0.01, 0.01)}


def ray_depth(city: CityFrame) -> Cases:
    """Numbers in place of the splats' depths, and the depths of all pixels by random numbers of
    splats."""
    frame, count = city.frame, len(city.frame.visible)
    numbers = np.random.default_rng(0).integers(1, count + 1, frame.image.shape[1:])
    depth = city.device.upload(numbers.astype(np.float64))
    return {
        "numbers": partial(along_rays.number_splats, city.device, frame.splats, DEFINES),
        "depths": partial(along_rays.ray_depth, city.device, city.rows, frame.visible, city.camera, depth, DEFINES),
    }


def sort(city: CityFrame) -> Cases:
    """The stable sort of a frame's visible gaussians by depth, which the item form of binning
    needs."""
    frame = city.frame
    _, depths = projection.project(city.device, city.rows, frame.visible, frame.counts, city.camera, 0, DEFINES)
    return {"depths": partial(stable_sort, city.device, depths, frame.counts)}


FAMILIES: dict[str, Callable[[CityFrame], Cases]] = {
    function.__name__: function
    for function in (
        adam,
        batch,
        bin,
        blend,
        choose,
        compact,
        contribution,
        cull,
        depth_map,
        exposure,
        frequency,
        gather,
        image_loss,
        match,
        noise,
        pages,
        pose,
        project,
        ray_depth,
        reduce,
        regularise,
        reproject,
        sift,
        signed_distance,
        sort,
        sweep,
    )
}


def time_family(family: str, bench: Bench) -> None:
    """Time all variants of a family."""
    for count in bench.gaussians:
        city = CityFrame(bench.device, count)
        for variant, function in FAMILIES[family](city).items():
            bench.report(family, variant, function, city.size)
