"""The gaussians at which a training begins: at sparse or dense points, at random, or a file's."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config.option import AUTO, is_auto
from clsplat.densify.options import GrowthOptions
from clsplat.densify.sphere import with_spheres
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.formats import count_of, read_model
from clsplat.io.models.values import morton_order
from clsplat.options import SceneOptions, TrainOptions, seconds_of
from clsplat.scene import Scene
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.registry import schedule_of
from clsplat.stereo.dense_points import Points, dense_points, sweep_seconds
from clsplat.training.part import Part, Survey
from clsplat.training.parts.entering_points import STATE, EnteringPoints
from clsplat.training.photos import SMALL_SIDE, decoded, with_side
from clsplat.training.progress import SilentProgress

if TYPE_CHECKING:
    from clsplat.training.start.prepare import PreparedScene

POINTS = ("sfm", "dense", "random")  # at which training begins where --init names no file
FEWEST_GAUSSIANS = 2  # their distance gives new gaussians a size
OF_THE_LIMIT = 0.8  # of the gaussians that the training may end with; growth places the rest
PIXELS_A_POINT = 40  # of the training photos, where the schedule has no limit
LEAST_OVERLAP = 0.5  # of the photos, that can be compared with others
# in a shorter training stereo would take most of the time, on a CPU
LEAST_STEPS, LEAST_SECONDS = 20, 2.0  # for each photo; the second of a time budget


def initial_gaussians(
    scene: Scene, options: TrainOptions, dense: tuple[NDArray[np.float64], NDArray[np.uint8]] | None = None
) -> Gaussians:
    """Gaussians at the sparse points, at dense points (positions and colours), at random points
    within their bounds, or from a file of gaussians or points.

    They have spheres if the options request it. Those of a coarse run are in an order in which
    neighbours lie together in memory, since a view sees a small part of them: of 39,600 gaussians,
    steps then take 3/4 of the time. Raises InputError where they are more than the options allow,
    or where the file cannot be used.
    """
    if dense is not None:
        gaussians = Gaussians.from_points(*dense, options.sh_degree)
    elif options.init in (AUTO, "sfm"):
        gaussians = Gaussians.from_points(scene.points, scene.colours, options.sh_degree)
    elif options.init == "random":
        rng = np.random.default_rng([options.seed, 0])
        low, high = np.percentile(scene.points, (1, 99), axis=0)
        points = rng.uniform(low, high, scene.points.shape)
        colours = rng.integers(0, 256, scene.points.shape).astype(np.uint8)
        gaussians = Gaussians.from_points(points, colours, options.sh_degree)
    else:
        if not os.path.isfile(options.init):
            raise InputError(
                f"{options.init}: no such file; --init expects sfm, dense, random or "
                "a file, such as the point_cloud.ply of a run"
            )
        gaussians = read_model(options.init, scene.offset, scene.georeference).scaled(1 / scene.unit)
        if gaussians.count < FEWEST_GAUSSIANS:
            raise InputError(
                f"{options.init}: has {gaussians.count} gaussians, and a training starts from at "
                f"least {FEWEST_GAUSSIANS}; give another file to --init, or leave it out"
            )
        gaussians = gaussians.with_sh_degree(options.sh_degree)
    if options.coarse:
        order = morton_order(gaussians.positions)
        gaussians = Gaussians({name: rows[order] for name, rows in gaussians.rows.items()}, gaussians.sh_degree)
    constrained = options.sphere and "spheres" in schedule_of(options.schedule).parts
    if constrained and "anchors" not in gaussians.rows:
        gaussians = with_spheres(gaussians, options.sphere_neighbours)
    if not constrained:  # drop the spheres of a file
        gaussians = gaussians.without_spheres()
    _check_limit(gaussians.count, options)
    return gaussians


def _check_limit(count: int, options: GrowthOptions) -> None:
    """InputError where a training would start with more gaussians than it may have."""
    if options.max_gaussians and count > options.max_gaussians:
        raise InputError(
            f"--max-gaussians {options.max_gaussians}: the scene starts with {count}; allow at least that many"
        )


def planned_initial(facts: SceneFacts, options: SceneOptions) -> SceneFacts:
    """The facts with the number of gaussians in the file at which training begins, if it does."""
    # a run that goes on no longer needs the file
    if options.init in (AUTO, *POINTS) or not os.path.isfile(options.init):
        return facts
    return replace(facts, count=count_of(options.init))


def chosen_start(survey: Survey, compared: Callable[[], Sequence[Sequence[int]]]) -> tuple[str, str]:
    """(the value of `init` that is used, the reason); InputError where dense points were requested
    and cannot be had. `compared` returns the `stereo_views` of the training views; it is called
    only where these matter."""
    scene, views, options = survey.scene, survey.views, survey.options
    dense = options.init == "dense"
    if not dense and not is_auto(options.init):
        return options.init, f"{options.init}: requested"
    if not dense:
        if not schedule_of(options.schedule).begins_dense:
            return "sfm", f"sfm: the sparse points, as --schedule {options.schedule} is published"
        if options.coarse:
            return "sfm", "sfm: the sparse points, in the coarse run of a city"
        if options.time_budget and seconds_of(options.time_budget) < LEAST_SECONDS * len(views):
            return "sfm", (
                f"sfm: the sparse points; dense ones need a time budget of "
                f"{LEAST_SECONDS:g} s for each of {len(views)} photos"
            )
        if options.iterations < LEAST_STEPS * len(views):
            return "sfm", (
                f"sfm: the sparse points; dense ones need {LEAST_STEPS} steps for each of {len(views)} photos"
            )
    overlap = sum(map(bool, compared()))
    counted = f"{overlap} of {len(views)} photos can be compared with two others"
    if dense:
        if not overlap:
            raise InputError(
                f"{scene.name}: --init dense needs three photos that share sparse "
                "points; there are none: use --init sfm"
            )
        return "dense", f"dense: requested; {counted}"
    if overlap < LEAST_OVERLAP * len(views):
        return "sfm", f"sfm: the sparse points, as only {counted}"
    return "dense", f"dense: {counted}"


def planned_count(limit: int | None, pixels: int, options: GrowthOptions) -> int:
    """How many dense points are wanted, by the number of gaussians that the schedule may end with
    (None: any) and the pixels of all training photos."""
    most = pixels // PIXELS_A_POINT if limit is None else limit
    if options.max_gaussians:
        most = min(most, options.max_gaussians)
    return max(1, int(OF_THE_LIMIT * most))


class Start(NamedTuple):
    """Where a training begins."""

    gaussians: Gaussians
    seconds: float  # that it took to find them, without the compilation of kernels
    parts: tuple[Part, ...] = ()  # that follow from them


def first_gaussians(device: Device, prepared: PreparedScene, progress: SilentProgress, enter: bool = True) -> Start:
    """The initial gaussians of a training; `enter`: dense points may enter with its levels."""
    began, options = time.perf_counter() - device.build_seconds, prepared.options
    part, dense = EnteringPoints(), None
    if options.init == "dense":
        points, pixels = _dense(device, prepared, progress)
        dense = points.positions, points.colours.round().astype(np.uint8)
        levels = prepared.decisions.values["levels"]
        enter &= prepared.decisions.facts.dense and len(levels) > 1
    if dense is not None and enter:
        _check_limit(len(points.sizes), options)
        gaussians = part.fill(dict(zip(STATE, (*dense, points.sizes, np.array([pixels])))), levels, options)
    else:
        gaussians = initial_gaussians(prepared.scene, options, dense)
    seconds = time.perf_counter() - device.build_seconds - began
    return Start(gaussians, seconds, (part,) if part.levels else ())


def _dense(device: Device, prepared: PreparedScene, progress: SilentProgress) -> tuple[Points, float]:
    """As many dense points as the decisions say, and the size of their cells."""
    progress.phase("finding dense points: reading photos")
    small, photos = prepared.thumbnails.of(range(len(prepared.train_views)))
    return dense_points(
        device,
        prepared.scene,
        small,
        photos,
        prepared.decisions.facts.count,
        lambda done: progress.phase(f"finding dense points: photo {done} of {len(small)}"),
        prepared.decisions.compared,
    )


def start_seconds(device: Device, prepared: PreparedScene) -> float:
    """About how long it will take to find the initial gaussians."""
    if prepared.options.init != "dense":
        return 0.0
    return sweep_seconds(
        device, prepared.scene, with_side(prepared.train_views, SMALL_SIDE), lambda views: list(decoded(views))
    )
