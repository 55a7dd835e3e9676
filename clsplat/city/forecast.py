"""What the blocks of a city will take, before one is trained."""

from clsplat.gaussians import LEARNED
from clsplat.io.scenes import read_scene
from clsplat.plan.forecast import MIB, Planned
from clsplat.report.page import Table
from clsplat.train.block import block_options
from clsplat.train.model import GROWTH_ROOM

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


def block_table(city, device, counts):
    """A Table of the blocks of a CityFolder: what each begins with, and the device memory and time
    it will take. One block, the largest, is planned with real steps; the others by it.

    counts: int[B], coarse gaussians that each owns.
    """
    records = [(block, block.read()) for block in city.blocks()]
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
        f"Gaussians of the coarse run; what they grow to, MiB and minutes are foretold on "
        f"{device.name}, from steps of block {largest.path.name}.",))
