"""How large a city becomes, and what a larger one like it would take."""

from collections.abc import Iterable
from pathlib import Path

from clsplat.device import Device
from clsplat.estimate.forecast import Forecast, Planned
from clsplat.gaussians import LEARNED
from clsplat.io.scenes.options import SceneOptions
from clsplat.options import ScheduledOptions
from clsplat.partition.options import BLOCK_STEPS, JOINT_STEPS, PartitionOptions
from clsplat.rendering.options import RenderingOptions
from clsplat.report.page import Table
from clsplat.scene import Scene
from clsplat.schedule import SceneFacts, schedule_of, worthwhile_steps
from clsplat.training.start.prepare import scene_facts

GIB = 2**30
COARSE_COST = 0.25  # time of the coarse run, as a share of the time of one run of the whole
PLY_BYTES = 248  # of a gaussian with all spherical harmonics
# of the device's memory for parameters and moments: frames take as much again, photos a quarter,
# and growth holds a part of the model twice for a moment
MODEL_SHARE = 0.27
LEAST_JOINT_STEPS = 450  # fewer are not worth it
PIXELS_PER_GAUSSIAN = 40  # of training photos, where the schedule has no limit


def facts_of_whole(scene: Scene, options: SceneOptions) -> tuple[SceneFacts, int]:
    """(The facts of the whole scene for its schedule, the number of training photos)."""
    scene = scene.reduced(options.downscale, options.max_resolution)
    views, _ = scene.split(options.test_every, options.test_offset)
    return scene_facts(scene, views), len(views)


def expected_gaussians(facts: SceneFacts, options: ScheduledOptions) -> int:
    """About how many gaussians the whole scene, with these facts, has at the end."""
    limit, _ = schedule_of(options.schedule).planned_limit(options, facts)
    return max(facts.count, facts.pixels // PIXELS_PER_GAUSSIAN if limit is None else limit)


def gaussians_that_fit(device: Device, options: RenderingOptions) -> int:
    """How many gaussians a block may have at the end on a device."""
    floats = sum(field.width(options.sh_degree) for field in LEARNED)
    each = 3 * floats * device.real.itemsize
    return max(1, int(MODEL_SHARE * device.handle.global_mem_size / each))


def scale_table(planned: Planned, forecast: Forecast, device: Device, photos: Iterable[int],
                workers: int = 1) -> Table:
    """The cost of cities with more photos like those of a planned scene, a row for each number.

    Everything grows with the number of photos, but a block is as large as the device allows, or
    smaller where there are more devices: `workers`, that train blocks at the same time.
    """
    views, options = planned.prepared.train_views, planned.prepared.options
    area = sum(view.camera.width * view.camera.height for view in views) / len(views)
    limit, shared = gaussians_that_fit(device, options), (1 + 2 * PartitionOptions().margin) ** 2
    rows = []
    for count in photos:
        share = count / len(views)
        gaussians = int(forecast.gaussians * share)
        whole = gaussians <= limit and workers == 1
        times, visits = (1, 1) if whole else (shared, BLOCK_STEPS)  # blocks that train a gaussian
        blocks = max(-(-int(gaussians * times) // limit), workers)
        coarse = 0.0 if whole else COARSE_COST * forecast.seconds * share
        trained = forecast.seconds * share * visits
        elapsed = coarse + trained / blocks * -(-blocks // workers)
        rows.append((f"{count:,}", f"{blocks:,}", f"{count * times / blocks:,.0f}",
                     f"{options.iterations * share * visits / blocks:,.0f}", f"{gaussians:,}",
                     f"{gaussians * PLY_BYTES / GIB:,.1f}",
                     f"{3 * area * count / GIB:,.1f}",
                     f"{(trained + coarse) / 3600:,.2f}", f"{elapsed / 3600:,.2f}"))
    head = ("photos", "blocks", "photos a block", "steps a block", "gaussians", "model, GiB",
            "pixels, GiB", "device hours", f"hours on {workers}")
    return Table("At scale", head, rows, range(9), (
        f"For photos like these, on {device.name}, in as few blocks as fit it and at "
        f"least one a device, which take {BLOCK_STEPS:g} times the steps of one run together. "
        "The coarse run is on one device.",))


def trains_jointly(facts: SceneFacts, photos: int, options: ScheduledOptions) -> bool:
    """Whether a city whose model a device holds is trained jointly at the end, if nobody says so.

    Only where one run takes all the steps that its photos allow: with fewer, blocks gain more by
    steps of their own (docs/evidence/cities.md). Other schedules than sig are trained as they were
    published, and a time budget is one of each block."""
    steps, most, _ = worthwhile_steps(options, facts, photos)
    return ("sig" in schedule_of(options.schedule).parts and not options.time_budget
            and steps == most and JOINT_STEPS * steps >= LEAST_JOINT_STEPS)


def one_block_note(options: PartitionOptions, scene: Path) -> str:
    """That a scene which fits the device in one block needs no city; empty for others."""
    if options.grid or options.blocks > 1:
        return ""
    return (f"this device holds the whole model in one block: `clsplat train {scene}` trains it in "
            "one stage, which is quicker and as good; --grid cuts it all the same")
