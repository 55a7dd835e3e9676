"""Cuts a city into blocks: which views and which start each has, and how many steps it takes."""

import dataclasses
import math
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import groupby
from operator import itemgetter
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.cities.block import decided_by, options_of_blocks
from clsplat.cities.choose import block_start, choose_gaussians, filled
from clsplat.cities.city import City
from clsplat.cities.exchange import exchange_steps, most_exchanges
from clsplat.config.option import differences, plain
from clsplat.device import Array, Device
from clsplat.device.host import host_memory
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.atomic import replacing
from clsplat.io.models.values import to_bytes
from clsplat.io.runs.city import DENSE, EXCHANGES, OTHERS, PARTITION, CityFolder
from clsplat.io.runs.run import read_exposures
from clsplat.io.scenes.write import link_again
from clsplat.loss.image_loss import image_loss, loss_value
from clsplat.options import LEAST_BYTES, bytes_of
from clsplat.partition.make import make_partition
from clsplat.partition.options import BLOCK_STEPS, PartitionOptions
from clsplat.partition.region import Partition, world_of
from clsplat.partition.windows import find_windows, owned_shares
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.project import Rows
from clsplat.report.figures.map import write_map
from clsplat.report.page import Table
from clsplat.scene import Scene
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.registry import schedule_of
from clsplat.training.start.prepare import smallest_size

REQUESTED = "asked"  # key of partition.json for the PartitionOptions
JOINT = "joint"  # key of partition.json for the options of the joint training, where there is one
LEAST_VISITS = 0.01  # of a view that was assigned to a block
INVISIBLE = -1e4  # the logit of an opacity that is not drawn
MOST_KEPT = 9  # arrays of opacities that stay on the device
# blocks that are written at the same time: each takes a core for the most part, and this much of
# the host's memory for a gaussian that it begins with
MOST_TOGETHER, ROW_BYTES, HOST_SHARE = 8, 600, 0.5


def cut_into_blocks(city: City, partition_options: PartitionOptions) -> Table:
    """Make the partition of a city whose coarse run is finished, its map, and the folders of its
    blocks; return a table of these.

    Existing ones stay as they are, and the partition must have been made with these options."""
    folder, options, scene = city.folder, city.options, city.pinhole  # blocks are pinhole scenes
    if folder.has_partition:
        _check_same(folder, partition_options)
        if _is_cut(folder, scene):
            return _block_table(folder)
    coarse = Run.open(folder.coarse)
    small, gaussians = coarse.options, coarse.finished_model
    dense = city.dense_gaussians(gaussians.sh_degree)
    decided = decided_by(coarse.folder)
    training = {view.name for view in scene.split(options.test_every, options.test_offset)[0]}
    views = np.flatnonzero([view.name in training for view in scene.views])
    one_run, facts = city.one_run
    if folder.has_partition:
        partition = folder.partition(scene)
    else:
        partition_options, drop = partition_options.decided(), None
        if partition_options.method == "citygs" and partition_options.grid != (1, 1):
            drop = partial(drop_changes, city.device, gaussians, scene.reduced(small.downscale, small.max_resolution))
        partition = make_partition(scene, partition_options, gaussians, views, drop)
        record = {**partition.record(), REQUESTED: plain(partition_options)}
        if steps_together := partition_options.joint_steps * one_run:
            # the growth of one run that begins at dense points, and the levels of one that begins
            # at a file of gaussians, with fewer steps
            given = block_steps(city, steps_together, smallest_size([scene.views[index] for index in views]), facts)
            record[JOINT] = {**options_of_blocks(given, decided), "depth": options.depth, "levels": options.levels}
        folder.write_partition(record)
    owner = partition.owner(world_of(scene, gaussians.positions))
    counts = np.bincount(owner, minlength=len(partition.regions))
    exposures = read_exposures(coarse.folder.path)
    requested = requested_of(folder)
    visits = visits_of_blocks(partition, scene, gaussians, owner, requested.get("block_steps", BLOCK_STEPS))
    steps = [one_run / len(views) * each.sum() for each in visits]
    # with a time budget it is not known before when which step is taken
    exchanges = (
        0
        if options.time_budget or len(steps) < 2
        else min(requested.get("exchanges") or 0, *(most_exchanges(round(number)) for number in steps))
    )

    device_in_use = Lock()

    def write(number: int) -> None:
        region, views = partition.regions[number], partition.views[number]
        own = dataclasses.replace(scene, views=tuple(scene.views[i] for i in views), observations=None)
        windows = find_windows(gaussians, scene, region, own.views)
        own = own.cropped(windows).reduced(options.downscale, options.max_resolution)
        with device_in_use:
            chosen = choose_gaussians(city.device, gaussians.positions, gaussians.log_scales, scene, region, own.views)
        part = block_start(gaussians, chosen)
        if dense:
            part = filled(part, dense, scene, region, options.max_gaussians)
        given = block_steps(city, steps[number], smallest_size(own.views), facts)
        if not any(view.depth for view in own.views):
            given["depth"] = ""
        if options.memory_budget:  # of the device, which others use at the same time
            each = bytes_of(options.memory_budget) // requested.get("sharing", 1)
            given["memory_budget"] = f"{max(LEAST_BYTES, each) >> 20}MiB"
        folder.write_block(
            number,
            scene,
            views,
            region,
            windows,
            part.gaussians,
            exposures,
            options_of_blocks(given, decided),
            {
                **folder.identity(),
                "views": len(views),
                "own": part.own,
                "margin": part.margin,
                "surroundings": part.surroundings,
                **({DENSE: part.dense} if dense else {}),
                OTHERS: sorted(set(owner[part.indices].tolist()) - {-1, number}),
                **({EXCHANGES: exchange_steps(given["iterations"], exchanges)} if exchanges else {}),
            },
            {view.name: float(each) for view, each in zip(own.views, visits[number])},
        )

    numbers = ((number,) for number in range(len(partition.regions)))
    rows = (
        (gaussians.count + (dense.count if dense else 0))
        * (1 + 2 * partition.regions[0].margin) ** 2
        / len(partition.regions)
    )
    together = int(min(MOST_TOGETHER, max(1, HOST_SHARE * host_memory() / (ROW_BYTES * rows))))
    for _ in called_ahead(write, numbers, together, together):
        pass  # an error is raised here
    with replacing(folder.picture) as file:
        write_map(file, partition, scene, counts.tolist())
    return _block_table(folder)


def _is_cut(city: CityFolder, scene: Scene) -> bool:
    """Whether all blocks and the map of a partition were written, as the record of a block is last;
    photos that were moved since are linked again."""
    partition, identity = city.partition(scene), city.identity()
    blocks = [city.block(number) for number in range(len(partition.regions))]
    if not city.picture.is_file() or not all(
        block.is_there and identity.items() <= block.read().items() for block in blocks
    ):
        return False
    for block, chosen in zip(blocks, partition.views):
        link_again(block.path, [scene.views[index] for index in chosen])
    return True


def _block_table(city: CityFolder) -> Table:
    """The start of each block of a city."""
    names = ("own", "margin", "surroundings", DENSE, "views")
    rows = [
        (block.path.name, *(f"{record.get(column, 0):,}" for column in names), f"{record['options']['iterations']:,}")
        for block in city.blocks()
        for record in [block.read("own", "margin", "views")]
    ]
    return Table(
        "Blocks",
        ("block", "gaussians", "margin", "around", "dense", "views", "steps"),
        rows,
        range(1, 7),
        (
            "Gaussians: of the coarse run; around: those that the block holds without training them; "
            "dense: those that begin at dense points, in gaps of the coarse model (--init sfm leaves "
            "them out).",
        ),
    )


def visits_of_blocks(
    partition: Partition, scene: Scene, gaussians: Gaussians, owner: NDArray[np.integer], together: float
) -> list[NDArray[np.float64]]:
    """How often each block visits each of its views, where a run of the whole scene does so once.

    In proportion to the share of a view's gaussians that the block owns. So a block learns from
    what shows most of it, and the steps of all blocks together do not depend on how many blocks a
    photo shows. No block takes more steps than one run does with its views; if none does, all take
    `together` visits. `owner` : the block of each gaussian of the coarse run, int[N]."""
    shares = owned_shares(
        owner, gaussians.positions.astype(np.float64), scene.views, scene.near_plane, len(partition.regions)
    )
    found = []
    for number, chosen in enumerate(partition.views):
        visits = np.maximum(together * shares[chosen, number], LEAST_VISITS)
        found.append(visits * min(1.0, len(chosen) / visits.sum()))
    return found


def block_steps(city: City, steps: float, size: tuple[int, int], facts: SceneFacts) -> dict[str, Any]:
    """The options, by name, of a block that takes this number of steps.

    `size` : (width, height) of its smallest training image; `facts` : of the whole."""
    schedule = schedule_of(city.options.schedule)
    shrunk = dataclasses.replace(city.options, iterations=max(1, round(steps)), eval_every=0)
    shrunk = dataclasses.replace(shrunk, **schedule.options_of_block(shrunk, size, facts))
    return {
        field.name: getattr(shrunk, field.name)
        for field in dataclasses.fields(shrunk)
        if field.name not in ("init", "coarse")
    }


def requested_of(city: CityFolder, key: str = REQUESTED) -> dict[str, Any]:
    """The PartitionOptions, by name, with which a city was cut, without those of later versions;
    with the key JOINT those of its joint training. Empty where there are none."""
    recorded = city.read_partition().get(key) or {}
    if not isinstance(recorded, dict):
        raise InputError(
            f"{city.path / PARTITION}: damaged ({key} is "
            f"{str(recorded)[:20]!r}); remove it, and make it with `clsplat partition "
            f"{city.path}`"
        )
    return recorded


def _check_same(city: CityFolder, options: PartitionOptions) -> None:
    """InputError where the existing blocks were cut with other options."""
    for name, old, new in differences({**plain(options), **requested_of(city)}, options):
        raise InputError(
            f"{city.path}: was cut with {name.replace('_', '-')} {old}, not {new}; "
            "remove its partition.json and blocks/, or choose another --output"
        )


def drop_changes(
    device: Device, gaussians: Gaussians, scene: Scene, tests: Iterable[tuple[int, NDArray[np.bool_]]]
) -> Iterator[float]:
    """1 - SSIM between renders of a view with all gaussians and with some; a `DropTest`.

    It is that of the training loss. The device compares both renders with the full one in 8 bits,
    so what these lack is the same in both, and the difference of the two values is taken. The scene
    is of the size of the renders, and the gaussians are in its frame.

    `tests` : (the index of a view, which gaussians are kept), all of a view in turn, as it is
    rendered once in full; the same array in tests of several views is uploaded once."""
    renderer = Renderer(device, gaussians.sh_degree, scene.near_plane)
    rows = {name: device.upload(values) for name, values in gaussians.rows.items()}

    def render(index: int, rows: Rows) -> Array:
        """real[3, H, W]: the image of a view."""
        camera = scene.views[index].camera
        return renderer.render(rows, renderer.pack(camera), camera.width, camera.height, gaussians.sh_degree).image

    # by the number of the array that tells what is kept, which stays in memory with it, and is then
    # no other's
    logits: dict[int, tuple[NDArray[np.bool_], Array]] = {}
    for index, of_view in groupby(tests, itemgetter(0)):
        image = render(index, rows)
        whole = device.upload(to_bytes(255 * image.download()))
        itself = _ssim(image, whole)
        for _, keep in of_view:
            if id(keep) not in logits:
                if len(logits) == MOST_KEPT:
                    logits.clear()
                logits[id(keep)] = keep, device.upload(np.where(keep, gaussians.opacity_logits, np.float32(INVISIBLE)))
            without = {**rows, "opacity_logits": logits[id(keep)][1]}
            yield itself - _ssim(render(index, without), whole)


def _ssim(image: Array, photo: Array) -> float:
    """The mean SSIM of an image and a photo on the device."""
    partials, _ = image_loss(image.device, image, photo, 1.0)
    return loss_value(partials, math.prod(image.shape), 1.0)[2]
