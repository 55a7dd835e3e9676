"""The benchmarks of single kernel families: what is timed, the bytes and the operations of it.

A family is a function that yields a `Case` for each thing to time. Bytes are those that the kernels
read and write, caches left aside; operations are additions, multiplications, comparisons and the
like that the algorithm needs, counted by hand in the source of the kernel, an exponential as 20.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import CATCH_UP_EVERY, COUNT_VISIBLE, LAZY_TERMS, POSE_REALS
from clsplat.densify.statistics import Statistics
from clsplat.device import Array, Device
from clsplat.gaussians import LEARNED
from clsplat.loss.depth_map import compare_depth
from clsplat.loss.exposure import Exposures
from clsplat.loss.image_loss import HAS_MAPS
from clsplat.loss.image_loss import image_loss as loss_and_gradient
from clsplat.loss.regularise import regularise as regularise_rows
from clsplat.loss.reproject import pack_pairs
from clsplat.loss.reproject import reproject as reproject_depth
from clsplat.optimise.adam import DeviceAdam
from clsplat.optimise.batch import BatchMean
from clsplat.optimise.noise import add_noise
from clsplat.optimise.numpy_adam import NumpyAdam
from clsplat.optimise.pose import RATE, Poses
from clsplat.primitives import compact as compacting
from clsplat.primitives import gather as gathering
from clsplat.primitives.compact import new_counts
from clsplat.primitives.reduce import sum_columns
from clsplat.primitives.sort import DIGIT_BITS, KEY_BITS, stable_sort
from clsplat.rendering import blend as blending
from clsplat.rendering import project as projection
from clsplat.rendering.bin import NEEDS_ORDER, bin_splats
from clsplat.rendering.contribution import contribution as contributions
from clsplat.rendering.cull import cull as cull_rows
from clsplat.rendering.project import pack_camera
from clsplat.response import Lenses
from clsplat.stereo import dense_points
from clsplat.stereo import sweep as sweeping
from clsplat.training.frequency import scene_frequency

from .measure import Bench
from .workloads import DEFINES, CityFrame, random_gradients, ring_camera

USED = {field.name: field.width(3) for field in LEARNED}
RATES = {field.name: field.rate for field in LEARNED}
WIDTH = sum(USED.values())  # reals of a gaussian of degree 3


@dataclass(frozen=True)
class Case:
    """Work to be timed.

    Attributes
    ----------
    variant : its name.
    function : does it.
    bytes, operations : of `function`; None if not counted.
    size : numbers that describe how much it is, beside those of all cases.
    """

    variant: str
    function: Callable[[], object]
    bytes: float | None = None
    operations: float | None = None
    size: Mapping[str, object] | None = None


Cases = Iterator[Case]


def time_family(family: str, argv: Sequence[str]) -> None:
    """Time all cases of a family and print them."""
    if family in IMAGE_FAMILIES:
        make_cases = IMAGE_FAMILIES[family]
        bench = Bench(argv, make_cases.__doc__, size=[1019, 766])
        width, height = bench.options.size
        _report(bench, family, make_cases(bench.device, width, height),
                {"width": width, "height": height})
        return
    of_a_city = CITY_FAMILIES[family]
    bench = Bench(argv, of_a_city.__doc__, gaussians="200k")
    for count in bench.options.gaussians:
        frame = CityFrame(bench.device, count)
        _report(bench, family, of_a_city(frame), frame.size)


def _report(bench: Bench, family: str, cases: Cases, size: Mapping[str, object]) -> None:
    for case in cases:
        bench.report(family, case.variant, bench.milliseconds(case.function),
                     {**size, **(case.size or {})}, case.bytes, case.operations)


# --- of the aerial city's first view


def adam(city: CityFrame) -> Cases:
    """Adam: a step, and how rows that lag catch up, for several shares of visible rows;
    and the numpy engine."""
    real, count = city.device.real.itemsize, city.count
    for share in (0.05, 0.25, 1.0):
        gradients = random_gradients(city.device, count, share)
        seen = len(gradients.rows)
        is_other = np.ones(count, np.uint32)
        is_other[gradients.rows.download()] = 0
        others, size = city.device.upload(is_other), {"visible": seen}
        # parameters and moments are read and written; 20 reals of gradients and what is masked
        engine = DeviceAdam(city.device, city.rows)
        yield Case("step", partial(engine.step, city.rows, gradients, 1, RATES, USED),
                   seen * (6 * WIDTH + 20) * real, 14 * seen * WIDTH, size)
        yield Case("catch up", partial(_catch_up, _lazy(city), city, others),
                   6 * WIDTH * seen * real + 12 * count, 14 * seen * WIDTH, size)
        for dense in (False, True):
            host = NumpyAdam(city.device, city.rows, dense)
            yield Case(f"numpy {'dense' if dense else 'sparse'}",
                       partial(host.step, city.rows, gradients, 1, RATES, USED), size=size)
    yield Case("catch up by camera", partial(_catch_up, _lazy(city), city, None),
               (6 * WIDTH * city.seen + 7 * count) * real, 14 * city.seen * WIDTH)


def _lazy(city: CityFrame) -> DeviceAdam:
    """An engine whose sums by which rows catch up are not zero."""
    engine = DeviceAdam(city.device, city.rows, True)
    sums = np.full((CATCH_UP_EVERY, LAZY_TERMS), 1e-9)
    engine.load_lag({**engine.lag(), "coefficients": sums}, 0)
    return engine


def _catch_up(engine: DeviceAdam, city: CityFrame, frozen: Array | None) -> None:
    """Let all rows that are not frozen miss 20 steps and catch up; only seen ones if None is."""
    engine.steps, engine.is_current = engine.steps + 20, False
    if frozen is not None:
        engine.catch_up(city.rows, frozen)
    else:
        engine.catch_up_seen(city.rows, engine.numbers(engine.steps + 1, RATES), 3, None,
                             city.camera, new_counts(engine.device))


def batch(city: CityFrame) -> Cases:
    """The mean of the gradients of several views, here of the same view several times."""
    gradients, counts = city.gradients(), new_counts(city.device)
    rows = {name: city.rows[name] for name in USED}

    def mean(sums: BatchMean) -> None:
        for _ in range(sums.views):
            sums.add(gradients, USED)
        sums.mean(counts, USED, sums.count)

    for views in (1, 4):
        # sums are cleared, read and written once a view, the gradient is read; then gathered
        reals = WIDTH * (city.count + (3 * views + 2) * city.seen)
        yield Case(f"mean of {views}", partial(mean, BatchMean(city.device, rows, views)),
                   reals * city.device.real.itemsize, 2 * views * city.seen * WIDTH)


def bin(city: CityFrame) -> Cases:
    """From splats to the pairs of every tile, in depth order."""
    device, frame, number = city.device, city.frame, city.pairs.count
    splats = len(frame.splats)
    # twice 7 reals of a splat and its count, and its offset; of a pair the splat and the emission
    # index are written
    traffic = splats * (2 * (4 + 7 * device.real.itemsize) + 4) + number * 8
    # the ellipse, and columns of about as many rows of tiles as pairs, both twice
    operations = 2 * (20 * splats + 30 * number)
    if NEEDS_ORDER.of(device):
        traffic += 2 * splats * 4
    else:  # a key of 8 bytes is written and read at both ends of the sort, a splat once
        lengths = np.diff(city.pairs.ranges.download().astype(np.int64)).ravel()
        stages = np.ceil(np.log2(np.maximum(lengths, 1)))
        traffic += number * (4 * 8 + 8)
        operations += int((lengths * stages * (stages + 1)).sum())  # two each comparison
    yield Case("splats to pairs", partial(bin_splats, device, frame.splats, frame.counts,
                                          frame.order, *frame.size, room=number),
               traffic, operations)


def blend(city: CityFrame) -> Cases:
    """Blending a frame's splats, and the adjoint by pair of tile and splat."""
    device, frame, background = city.device, city.frame, city.renderer.background
    (width, height), pairs, real = frame.size, city.pairs.count, city.device.real.itemsize
    pixels = city.blended_pixels()
    for depth in (False, True):
        defines, name = blending.blend_defines(depth), " with depth" * depth
        forward = partial(blending.blend, device, frame.splats, city.pairs, width, height,
                          background, defines)
        blended = forward()
        # the group form's states of every bucket, written and read
        states = 0 if blended.checkpoints is None else blended.checkpoints.nbytes
        image = width * height * (4 * real + 4) + states
        size = {"blended_pixels": pixels}
        yield Case("forward" + name, forward, pairs * (4 + 12 * real) + image, 39 * pixels, size)
        # any gradients will do: their values do not change the work
        yield Case("adjoint" + name, partial(
            blending.blend_adjoint, device, frame.splats, city.pairs, blended, background,
            blended.image, blended.depth_channel, blended.depth_channel, defines),
            pairs * (8 + 21 * real) + image, 62 * pixels, size)


def compact(city: CityFrame) -> Cases:
    """The list of a frame's visible gaussians from their flags."""
    flags, totals = cull_rows(city.device, city.rows, city.camera, DEFINES)
    kept = partial(compacting.compact, city.device, flags, new_counts(city.device), city.seen)
    # a flag is added up as often as it is read, and a row number is kept
    for variant, function, reads in (("totals from culling", partial(kept, totals), 1),
                                     ("with its totals", kept, 2)):
        yield Case(variant, function, reads * flags.nbytes + 4 * city.seen, reads * city.count)


def contribution(city: CityFrame) -> Cases:
    """The contribution of each splat of a frame."""
    device, real, (width, height) = city.device, city.device.real.itemsize, city.frame.size
    weights = device.upload(np.random.default_rng(0).random((height, width)))
    # two indices, the splat and four sums a pair, and the sums again to add them up
    traffic = (city.pairs.count * (8 + 20 * real) + width * height * (4 + real)
               + len(city.frame.splats) * 4 * real)
    pixels = city.blended_pixels()
    yield Case("all splats", partial(contributions, device, city.frame, weights), traffic,
               45 * pixels, {"blended_pixels": pixels})


def cull(city: CityFrame) -> Cases:
    """Culling: which gaussians a view sees."""
    real = city.device.real.itemsize
    # position, scales and a flag; of those that are visible the rotation and opacity too
    yield Case("all gaussians", partial(cull_rows, city.device, city.rows, city.camera, DEFINES),
               city.count * (6 * real + 4) + city.seen * 5 * real,
               60 * city.count + 180 * city.seen)


def frequency(city: CityFrame) -> Cases:
    """The nine scene frequencies of the city, including their download."""
    rows = {name: city.rows[name] for name in ("log_scales", "opacity_logits")}
    # the maxima and then the sums each read every row and make its terms (ten functions of 20
    # operations); then come 11 maxima, or 11 exponentials and sums
    yield Case("nine values", partial(scene_frequency, city.device, rows),
               2 * sum(array.nbytes for array in rows.values()),
               city.count * (2 * 230 + 11 + 22 * 11))


def gather(city: CityFrame) -> Cases:
    """Gather and scatter of the rows of a frame's visible gaussians, in its order."""
    device, visible = city.device, city.frame.visible
    for name in ("positions", "sh_rest"):
        rows = city.rows[name]
        gathered = gathering.gather(device, rows, visible)
        traffic = 2 * gathered.nbytes + visible.nbytes
        yield Case(f"gather {name}", partial(gathering.gather, device, rows, visible, gathered),
                   traffic, 0)
        yield Case(f"scatter {name}", partial(gathering.scatter, device, gathered, visible, rows),
                   traffic, 0)


def noise(city: CityFrame) -> Cases:
    """Random steps of the positions of a model of which one gaussian in so many is transparent."""
    counts, real = new_counts(city.device), city.device.real
    for every in (10, 1):
        city.rows["opacity_logits"].write(
            np.where(np.arange(city.count) % every == 0, -9.0, 2.0).astype(real))
        moved = city.count // every
        # of a row that moves 13 reals are read and written, of any other one
        yield Case(f"one in {every}", partial(add_noise, city.rows, 1e-6, 1, 0, counts),
                   (city.count + 13 * moved) * real.itemsize, 100 * moved)


def pose(city: CityFrame) -> Cases:
    """The corrected camera of a view and a step on its pose, by the gradients of many gaussians."""
    device = city.device
    poses = Poses(device, 100 * [ring_camera(0, city.frame.size)], 1.0)
    terms = device.upload(np.random.default_rng(0).normal(size=(city.count, POSE_REALS)))
    counts = new_counts(device, city.count)

    def both() -> None:
        poses.apply(0, city.camera)
        poses.step(0, RATE, city.camera, terms, counts)

    yield Case("camera and step", both, terms.nbytes, POSE_REALS * city.count)


def project(city: CityFrame) -> Cases:
    """Project and its adjoint, all spherical harmonics active."""
    device, frame, real, seen = city.device, city.frame, city.device.real.itemsize, city.seen
    token = device.zeros((1, 1))
    splat_grads = blending.blend_adjoint(
        device, frame.splats, city.pairs, frame.blended, city.renderer.background, frame.image,
        token, token, blending.blend_defines(with_depth=False))
    inputs = device, city.rows, frame.visible, frame.counts, city.camera, 3, DEFINES
    yield Case("project", partial(projection.project, *inputs), seen * (8 + (WIDTH + 12) * real),
               330 * seen)
    # parameters, gradients (those of the harmonics as 6 numbers) and the mean's, nine gradients of
    # each pair, four indices
    yield Case("adjoint", partial(projection.project_adjoint, *inputs, splat_grads,
                                  city.renderer.skipped),
               seen * (16 + (WIDTH + 19) * real) + city.pairs.count * 9 * real, 700 * seen)


def reduce(city: CityFrame) -> Cases:
    """Column sums: of the partial sums of an image loss, and of one value for each gaussian."""
    rng = np.random.default_rng(0)
    # 3 channels of 1019 x 766 pixels in tiles of 16 x 16
    for variant, shape in (("loss", (3 * 64 * 48, 2)), ("gaussians", (city.count, 1))):
        rows = city.device.upload(rng.random(shape))
        yield Case(variant, partial(sum_columns, city.device, rows), rows.nbytes,
                   shape[0] * shape[1], {"rows": shape[0], "columns": shape[1]})


def regularise(city: CityFrame) -> Cases:
    """Regularisation of the opacities and sizes of the gaussians that a view sees."""
    # opacity and scales of a gaussian, and their gradients read and written
    yield Case("of a view", partial(regularise_rows, city.rows, city.gradients(), 0.01, 0.01),
               12 * city.seen * city.device.real.itemsize, 20 * city.seen)


def sort(city: CityFrame) -> Cases:
    """The stable sort of a frame's visible gaussians by depth, which the item form of binning
    needs."""
    device, counts = city.device, city.frame.counts
    _, depths = projection.project(device, city.rows, city.frame.visible, counts, city.camera, 0,
                                   DEFINES)
    keys, passes = int(counts.download()[COUNT_VISIBLE]), -(-KEY_BITS // DIGIT_BITS)
    # a pass reads keys twice and values, but for the first, and writes both; its digit is a shift
    # and a mask, twice, and counts up twice
    yield Case("depths", partial(stable_sort, device, depths, counts), keys * (20 * passes - 4),
               6 * keys * passes, {"keys": keys})


def statistics(city: CityFrame) -> Cases:
    """The adjoint of a frame with and without its screen gradients, summed by gaussian."""
    image = city.frame.image
    grad = city.device.upload(np.full(image.shape, 1 / np.prod(image.shape)))
    for name, sums in (("with", Statistics(city.device, city.count).sums), ("without", None)):
        yield Case(f"adjoint {name} statistics", partial(
            city.renderer.adjoint, city.rows, city.frame, grad, statistics=sums))


# --- of an image


def depth_map(device: Device, width: int, height: int) -> Cases:
    """A rendered depth against a depth map, at the size of a real photo."""
    depths = np.random.default_rng(0).normal(125, 3, (height, width))
    depth, transmittance, known = (device.upload(values) for values in (
        0.75 * depths, np.full(depths.shape, 0.25), depths * 1.02))
    # three planes read, two gradients written
    yield Case("value and gradient", partial(compare_depth, device, depth, transmittance, known,
                                             1.0), 5 * depth.nbytes, 20 * width * height)


def exposure(device: Device, width: int, height: int) -> Cases:
    """The adjoint of a view's response and its step, at the size of a real photo."""
    rng = np.random.default_rng(0)
    image = device.upload(rng.random((3, height, width)))
    grad, counts = device.upload(rng.normal(size=image.shape)), new_counts(device)
    camera = ring_camera(0, (width, height))
    packed, lenses = pack_camera(device, camera, 0.01), Lenses.of_cameras(100 * [camera])

    def both(exposures: Exposures) -> None:
        exposures.step(0, exposures.adjoint(0, packed, image, grad)[1], counts)

    # a pixel takes a transposed matrix of 3 x 3 and twelve sums of products; with vignetting, the
    # squared radius, the gain and its products, and three sums more
    for extra, operations in (("", 36), ("vignetting", 66)):
        exposures = Exposures(device, 100, lenses=lenses if extra else None)
        # the image and the gradient are read, the gradient by the image is written
        yield Case("adjoint and step" + f" with {extra}" * bool(extra), partial(both, exposures),
                   3 * image.nbytes, operations * width * height)


def image_loss(device: Device, width: int, height: int) -> Cases:
    """L1 and D-SSIM with the gradient, at the size of a real photo."""
    rng = np.random.default_rng(0)
    image = device.upload(rng.random((3, height, width)))
    photo = device.upload(rng.integers(0, 256, image.shape, np.uint8))
    # image and photo are read twice and the gradient is written; in the group form, three maps are
    # written and read
    reads = 2 + 6 * HAS_MAPS.of(device) + 1
    # a value: 11 taps along both axes of four means and of three maps, SSIM and its gradients
    operations = 2 * 2 * 11 * (4 + 3) + 60
    yield Case("value and gradient", partial(loss_and_gradient, device, image, photo, 0.2),
               reads * image.nbytes + 2 * photo.nbytes, operations * 3 * width * height)


def reproject(device: Device, width: int, height: int) -> Cases:
    """Reprojection of a rendered depth into a source view, at the size of a real photo."""
    rng = np.random.default_rng(0)
    photo, neighbour = (device.upload(rng.integers(0, 256, (3, height, width), np.uint8))
                        for _ in range(2))
    # about as far as the middle of the city
    depth = device.upload(0.75 * rng.normal(125, 3, (height, width)))
    transmittance = device.upload(np.full((height, width), 0.25))
    size = width, height
    geometries = pack_pairs(device, [(ring_camera(0, size), ring_camera(0.1, size))])
    colours = device.upload(np.eye(3, 4).reshape(1, 12))
    function = partial(reproject_depth, device, depth, transmittance, photo, neighbour, geometries,
                       colours, 0, 1.0)
    # depth and transmittance read, two gradients written, read and written; both photos read. A
    # pixel is turned into the other camera and compared in three channels, each between four
    # others, with the derivatives by depth
    yield Case("value and gradient", function, (2 + 2 * 3) * depth.nbytes + 2 * photo.nbytes,
               160 * width * height, {"valid": int(function()[0].last())})


def sweep(device: Device, width: int, height: int) -> Cases:
    """A plane sweep of one photo over others, and the confirmation of its depths by these, at a
    quarter of the size, about as trainings compare photos."""
    width, height = max(16, width // 4), max(16, height // 4)
    sources, planes = dense_points.SOURCES, dense_points.PLANES
    photos = list(np.random.default_rng(0).uniform(0, 1, (1 + sources, height, width)))
    cameras = [Camera(width, height, (width, width), (width / 2, height / 2), np.eye(3),
                      np.array([-0.1 * number, 0, 0])) for number in range(len(photos))]
    images, sizes = sweeping.device_images(device, photos)
    others, pixels, size = range(1, len(photos)), width * height, {"width": width, "height": height}
    windows = 16 * planes + 7 * 49  # pixels of the windows of all planes, coarse and fine
    # a pixel of a window takes its place, four pixels and three sums
    yield Case(f"{sources} sources", partial(sweeping.sweep, images, sizes, cameras, 0, others,
                                             (0.1, 1.0), planes),
               images.nbytes + 2 * pixels * device.real.itemsize, 30 * windows * sources * pixels,
               size)
    depths = device.upload(np.full(images.shape, 0.5))
    yield Case(f"confirm, {sources} sources", partial(
        sweeping.confirm, depths, sizes, cameras, 0, others, dense_points.SAME_DEPTH),
        depths.nbytes + 4 * pixels, 25 * sources * pixels, size)


CITY_FAMILIES: dict[str, Callable[[CityFrame], Cases]] = {
    function.__name__: function for function in (
        adam, batch, bin, blend, compact, contribution, cull, frequency, gather, noise, pose,
        project, reduce, regularise, sort, statistics)}
IMAGE_FAMILIES: dict[str, Callable[[Device, int, int], Cases]] = {
    function.__name__: function for function in (
        depth_map, exposure, image_loss, reproject, sweep)}
