"""Forecasts of the memory and time of a city's blocks."""

from collections.abc import Iterable

from clsplat.device import Device
from clsplat.estimate.forecast import MIB, Forecast, Planned
from clsplat.estimate.measured import MeasuredSteps
from clsplat.estimate.step_time import fitted
from clsplat.gaussians import LEARNED
from clsplat.io.city import LAYERS, CityFolder
from clsplat.io.scenes import read_scene
from clsplat.options import TrainOptions
from clsplat.report.page import Table
from clsplat.scene import Scene
from clsplat.schedule import schedule_of
from clsplat.training.block import block_options
from clsplat.training.facts import scene_facts
from clsplat.training.model import GROWTH_ROOM

GIB = 2**30
COARSE_COST = 0.25  # time of the coarse run, as a share of the time of one run of the whole
PLY_BYTES = 248  # of a gaussian with all spherical harmonics
# for each block, of a cluster's scheduler, client and workers: tools/studies/simulate.py
DASK_SECONDS, DASK_BYTES = 0.05, 12_000
MODEL_SHARE = 0.4  # of the device's memory for parameters and moments; a step needs as much again
PIXELS_PER_GAUSSIAN = 40  # of training photos, where the schedule has no limit


def expected_gaussians(scene: Scene, options: TrainOptions) -> int:
    """About how many gaussians the whole scene has at the end."""
    scene = scene.reduced(options.downscale, options.max_resolution)
    views, _ = scene.split(options.test_every, options.test_offset)
    facts = scene_facts(scene, views)
    limit, _ = schedule_of(options.schedule).planned_limit(options, facts)
    return max(facts.count, facts.pixels // PIXELS_PER_GAUSSIAN if limit is None else limit)


def gaussians_that_fit(device: Device, options: TrainOptions, memory_bytes: int = 0) -> int:
    """How many gaussians a block may have at the end on a device.

    Parameters
    ----------
    device, options : of the training.
    memory_bytes : of another device that is meant; 0: this one's.
    """
    degree = options.sh_degree if isinstance(options.sh_degree, int) else 3  # auto
    floats = sum(field.width(degree) for field in LEARNED)
    each = 3 * floats * GROWTH_ROOM * device.real.itemsize
    return max(1, int(MODEL_SHARE * (memory_bytes or device.handle.global_mem_size) / each))


def scale_table(planned: Planned, forecast: Forecast, device: Device, margin: float,
                photos: Iterable[int], size: tuple[int, int] | None = None, workers: int = 1,
                known: MeasuredSteps | None = None) -> Table:
    """The cost of cities with more photos like those of a planned scene.

    Everything grows with the number of photos, but a block is as large as the device allows, or
    smaller where there are more devices. With the size of a photo grow the gaussians that it
    shows, and what a step takes but for its fixed part.

    Parameters
    ----------
    planned, forecast : of the scene, which is taken as typical.
    margin : of blocks.
    photos : numbers of photos, a row for each.
    size : width and height of the photos; None: those of the scene.
    workers : devices that train blocks at the same time.
    known : steps of another device, on which `forecast` rests; None: `device` is meant.
    """
    views, options = planned.prepared.train_views, planned.prepared.options
    pixels = sum(view.camera.width * view.camera.height for view in views) / len(views)
    larger = 1.0 if size is None else size[0] * size[1] / pixels
    fixed = fitted(forecast.measured)[0] * forecast.steps if size else 0.0
    once = fixed + larger * (forecast.seconds - fixed)  # all steps of the scene
    limit = gaussians_that_fit(device, options, known.memory_bytes if known else 0)
    shared = (1 + 2 * margin) ** 2
    rows = []
    for count in photos:
        share = count / len(views)
        gaussians = int(forecast.gaussians * share * larger)
        whole = gaussians <= limit and workers == 1
        times = 1 if whole else shared  # blocks that train with a photo, on average
        blocks = max(-(-int(gaussians * times) // limit), workers)
        coarse = 0.0 if whole else COARSE_COST * once * share
        trained = once * share * times
        elapsed = coarse + trained / blocks * -(-blocks // workers)
        steps = options.iterations * share * times / blocks
        rows.append((f"{count:,}", f"{blocks:,}", f"{count * times / blocks:,.0f}",
                     f"{steps:,.0f}", f"{gaussians:,}", f"{gaussians * PLY_BYTES / GIB:,.1f}",
                     f"{3 * larger * pixels * count / GIB:,.1f}",
                     f"{(trained + coarse) / 3600:,.2f}", f"{elapsed / 3600:,.2f}",
                     f"{DASK_SECONDS * blocks:,.1f}", f"{DASK_BYTES * blocks / MIB:,.2f}"))
    head = ("photos", "blocks", "photos a block", "steps a block", "gaussians", "model, GiB",
            "pixels, GiB", "device hours", f"hours on {workers}", "scheduler, s", "MiB")
    name = known.device if known else device.name
    of_size = f" of {size[0]}x{size[1]}" if size else ""
    return Table("At scale", head, rows, range(11), (
        f"For photos like these{of_size}, on {name}, in as few blocks as fit it and at least one a "
        "device, with as many steps a photo; a part of a scene that two blocks train counts twice. "
        "The coarse run is on one device. Scheduler: total CPU time and bytes of a Dask cluster.",
    ))


def block_table(city: CityFolder, device: Device, counts: Iterable[int]) -> Table:
    """The start of each block of a city, and a forecast of its device memory and time.

    The largest block is planned with real steps, the others in proportion to it.

    Parameters
    ----------
    counts : [B], coarse gaussians that each block owns.
    """
    records = [(block, block.read("own", "margin", "surroundings", "views"))
               for block in city.blocks()]
    initial = {block.path.name: sum(record[key] for key in ("own", "margin", "surroundings"))
               for block, record in records}
    largest, record = max(records, key=lambda pair: initial[pair[0].path.name])
    forecast = Planned(read_scene(largest.path), block_options(largest), device).forecast()
    growth = forecast.gaussians / initial[largest.path.name]
    rows = []
    for (block, record), count in zip(records, counts):
        size = initial[block.path.name] / initial[largest.path.name]
        steps = record["options"]["iterations"] / forecast.steps
        rows.append((block.path.name, f"{count:,}", f"{record['margin']:,}",
                     f"{record['surroundings']:,}", f"{record.get(LAYERS, 0):,}",
                     f"{record['views']}",
                     f"{record['options']['iterations']:,}",
                     f"{growth * initial[block.path.name]:,.0f}",
                     f"{size * forecast.memory.total / MIB:,.0f}",
                     f"{steps * forecast.seconds / 60:.1f}"))
    head = ("block", "gaussians", "margin", "around", "in layers", "views", "steps", "at the end",
            "MiB", "minutes")
    return Table("Blocks", head, rows, range(1, 10), (
        "Gaussians: of the coarse run; around: those that the block holds without training them; "
        "in layers: those that it only draws, once for each view, where that takes less memory "
        "(--surroundings). The number at the end, MiB and "
        f"minutes are forecasts for a block that has {device.name} to itself, from steps of block "
        f"{largest.path.name}.",))
