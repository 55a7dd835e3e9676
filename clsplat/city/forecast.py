"""What the blocks of a city will take, before one is trained."""

from clsplat.estimate.forecast import MIB, Planned
from clsplat.gaussians import LEARNED
from clsplat.io.scenes import read_scene
from clsplat.report.page import Table
from clsplat.training.block import block_options
from clsplat.training.model import GROWTH_ROOM

GIB = 2**30
COARSE_COST = 0.25  # of the time of one run of the whole, that the coarse run takes
PLY_BYTES = 248  # a gaussian with all harmonics
# of a cluster's scheduler, client and workers together, a block: tools/studies/simulate.py
DASK_SECONDS, DASK_BYTES = 0.05, 12_000
MODEL_SHARE = 0.4  # of the device's memory for parameters and moments; a step needs as much again
PIXELS = 40  # of training photos a gaussian, which is where sig ends at the latest


def expected_gaussians(scene, options):
    """About how many the whole scene ends with."""
    views, _ = scene.reduced(options.downscale, options.max_resolution).split(options.test_every)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return max(len(scene.points), int(pixels / (options.pixels_per_gaussian or PIXELS)))


def gaussians_that_fit(device, options):
    """How many a block may end with on this device."""
    degree = 3 if options.sh_degree == "auto" else options.sh_degree
    floats = sum(field.width(degree) for field in LEARNED)
    each = 3 * floats * GROWTH_ROOM * device.real.itemsize
    return max(1, int(MODEL_SHARE * device.handle.global_mem_size / each))


def scale_table(planned, forecast, device, margin, photos):
    """A Table of what cities of so many photos of the kind of a planned scene would take.

    planned, forecast: the Planned and its Forecast of a scene that stands for the whole;
    margin: of blocks; photos: numbers of them. Everything grows with their number but for a block,
    which is as large as the device allows.
    """
    views, options = planned.prepared.train_views, planned.prepared.options
    pixels = sum(view.camera.width * view.camera.height for view in views) / len(views)
    limit, shared = gaussians_that_fit(device, options), (1 + 2 * margin) ** 2
    rows = []
    for count in photos:
        share = count / len(views)
        gaussians = int(forecast.gaussians * share)
        whole = gaussians <= limit
        times = 1 if whole else shared  # that a photo is trained with, on average
        blocks = -(-int(gaussians * times) // limit)
        seconds = forecast.seconds * share * (times + (0 if whole else COARSE_COST))
        steps = options.iterations * share * times / blocks
        rows.append((f"{count:,}", f"{blocks:,}", f"{count * times / blocks:,.0f}",
                     f"{steps:,.0f}", f"{gaussians:,}", f"{gaussians * PLY_BYTES / GIB:,.1f}",
                     f"{3 * pixels * count / GIB:,.1f}", f"{seconds / 3600:,.1f}",
                     f"{DASK_SECONDS * blocks:,.1f}", f"{DASK_BYTES * blocks / MIB:,.2f}"))
    head = ("photos", "blocks", "photos a block", "steps a block", "gaussians", "model, GiB",
            "pixels, GiB", "device hours", "scheduler, s", "MiB")
    return Table("At scale", head, rows, range(10), (
        f"Photos like these, on {device.name}, in as few blocks as fit it, at as many steps a "
        "photo; a part of a scene that two blocks train counts twice. Scheduler: CPU and bytes of "
        "a Dask cluster in all.",))


def block_table(city, device, counts):
    """A Table of the blocks of a CityFolder: what each begins with, and the device memory and time
    it will take. One block, the largest, is planned with real steps; the others by it.

    counts: int[B], coarse gaussians that each owns.
    """
    records = [(block, block.read("own", "margin", "surroundings", "views"))
               for block in city.blocks()]
    begins = {block.path.name: sum(record[key] for key in ("own", "margin", "surroundings"))
              for block, record in records}
    largest, record = max(records, key=lambda pair: begins[pair[0].path.name])
    forecast = Planned(read_scene(largest.path), block_options(largest), device).forecast()
    grown = forecast.gaussians / begins[largest.path.name]
    rows = []
    for (block, record), count in zip(records, counts):
        size = begins[block.path.name] / begins[largest.path.name]
        steps = record["options"]["iterations"] / forecast.steps
        rows.append((block.path.name, f"{count:,}", f"{record['margin']:,}",
                     f"{record['surroundings']:,}", f"{record['views']}",
                     f"{record['options']['iterations']:,}",
                     f"{grown * begins[block.path.name]:,.0f}",
                     f"{size * forecast.memory.total / MIB:,.0f}",
                     f"{steps * forecast.seconds / 60:.1f}"))
    head = ("block", "gaussians", "margin", "around", "views", "steps", "at the end", "MiB",
            "minutes")
    return Table("Blocks", head, rows, range(1, 9), (
        "Gaussians of the coarse run; what they grow to, MiB and minutes are predicted for a "
        f"block that has {device.name} to itself, from steps of block {largest.path.name}.",))
