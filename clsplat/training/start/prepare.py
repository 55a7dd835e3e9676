"""From a scene as it was read to one that is ready for training, with all decisions made."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.option import AUTO, MOST_STEPS
from clsplat.covisibility.photometry import LUMA, colour_disagreement
from clsplat.covisibility.source_views import photos_of_a_point
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, mean_inverse_distance
from clsplat.io.photos.depth import with_depths
from clsplat.options import RunOptions, ScheduledOptions, TrainOptions, bytes_of
from clsplat.placement.corrections import typical_depth
from clsplat.scene import LEAST_PARALLAX, Scene, View
from clsplat.schedule.plan import SceneFacts, Schedule
from clsplat.schedule.registry import schedule_of
from clsplat.schedule.simulate import largest, simulate
from clsplat.schedule.steps import scaled_steps, worthwhile_steps
from clsplat.stereo.dense_points import stereo_views
from clsplat.training.model import DEVICE_SHARE, model_bytes
from clsplat.training.part import Decision, Part, Survey, requested
from clsplat.training.parts import PARTS, registered_part
from clsplat.training.photos import Thumbnails, decoded
from clsplat.training.start.initialise import chosen_start, planned_count, planned_initial

SAMPLED_PHOTOS = 16
SAMPLED_POINTS = 10_000
CELLS = 8  # across a photo, to measure how much of it the points cover
FEW_PHOTOS, FEW_POINTS = 10, 100
LEAST_COVER = 0.05  # of a photo's cells; 0.6 to 1 in four aerial and street scenes
LEAST_CONTRAST = 2.0  # grey levels, standard deviation: less is a uniform photo
RUNS, RUN = 4, 12  # of photos that follow each other, and so show the same places


@dataclass(frozen=True, eq=False)
class Decisions:
    """All decisions about a training before it begins."""

    options: TrainOptions  # with values instead of "auto", and with scaled steps
    facts: SceneFacts  # for the schedule, with the planned number of initial gaussians
    most_steps: int  # which a time budget may not exceed
    parts: dict[str, Decision]  # what is decided -> the decision
    compared: list[list[int]] | None = None  # `stereo_views`, where training begins dense

    @property
    def reasons(self) -> dict[str, str]:
        """What is decided -> sentence."""
        return {name: part.reason for name, part in self.parts.items()}

    @property
    def values(self) -> dict[str, Any]:
        """What is decided -> what is used, for the record, whose options are those requested."""
        return {name: part.value for name, part in self.parts.items()}


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene that is ready for training."""

    # with photos at the size of training; its unit is its extent, so that steps do not depend on
    # the unit of the coordinates
    scene: Scene
    train_views: tuple[View, ...]
    test_views: tuple[View, ...]  # held out
    decisions: Decisions
    thumbnails: Thumbnails  # of the training views
    given: tuple[Part, ...] = ()  # parts besides those that the options ask for

    @property
    def options(self) -> TrainOptions:
        """The options after all decisions."""
        return self.decisions.options

    @property
    def near(self) -> float:
        """Distance of the near plane, in units of the scene."""
        return self.scene.near(self.options.near)

    @property
    def pixel(self) -> float:
        """World units: the size of a pixel of the photos at the scene, the median of some."""
        views = self.train_views[:: -(-len(self.train_views) // SAMPLED_PHOTOS)]
        cameras = [view.camera for view in views]
        return typical_depth(cameras, self.scene.points) / float(np.median([camera.focal for camera in cameras]))

    def schedule(self, gaussians: Gaussians, options: ScheduledOptions | None = None, count: int = 0) -> Schedule:
        """A new schedule for these initial gaussians; `options` replace those of the scene, and
        `count` is their number, if those given are a part of them."""
        options = options or self.options
        facts = replace(self.decisions.facts, count=count or gaussians.count)
        for part in self.given:
            facts = part.facts(facts, self.scene, self.train_views, gaussians)
        return schedule_of(options.schedule)(options, facts)


def prepare(
    scene: Scene, options: TrainOptions, device: Device | None = None, parts: Iterable[Part] = ()
) -> PreparedScene:
    """Prepare a scene for training, with options as they were given, and with `parts` besides those
    that they ask for; InputError where that is impossible."""
    parts = tuple(parts)
    scene = with_depths(scene, options.depth)
    scene = scene.reduced(options.downscale, options.max_resolution).normalised()
    if len(scene.views) < 2:
        raise InputError(
            f"{scene.name}: has a single photo; depth needs at least two from "
            "different places, and 20 or more make a good model"
        )
    train_views, test_views = scene.split(options.test_every, options.test_offset)
    if options.robust == "on":
        train_views = tuple(replace(view, weighed=True) for view in train_views)
    if not train_views:
        raise InputError(
            f"{scene.name}: --test-every {options.test_every} holds out every view; use a larger number, or none"
        )
    if options.test_offset and not test_views:
        raise InputError(
            f"{scene.name}: --test-offset {options.test_offset} holds out none of its "
            f"{len(scene.views)} views; use a smaller number"
        )
    survey = Survey(scene, train_views, options, Thumbnails(train_views))
    return PreparedScene(
        scene, train_views, test_views, find_decisions(survey, device, parts), survey.thumbnails, parts
    )


def scene_facts(scene: Scene, views: Sequence[View], thumbnails: Thumbnails | None = None) -> SceneFacts:
    """The facts of a scene for its schedule, if gaussians begin at its sparse points; `views` are
    its training views, at the size of training, and `thumbnails` of these."""
    return SceneFacts(
        smallest_size(views),
        len(scene.points),
        mean_inverse_distance(scene.points) / scene.unit,
        lambda: (photo[:3] for photo in decoded(views)),
        sum(view.camera.width * view.camera.height for view in views),
        functools.cache(functools.partial(_disagreement, scene, thumbnails or Thumbnails(views))),
        photos_of_a_point(scene, views),
    )


def _disagreement(scene: Scene, thumbnails: Thumbnails) -> float:
    """The disagreement of some of the photos."""
    count = len(thumbnails.views)
    chosen = (
        range(count)
        if count <= RUNS * RUN
        else [begin * (count - RUN) // (RUNS - 1) + number for begin in range(RUNS) for number in range(RUN)]
    )
    return colour_disagreement(scene, *thumbnails.of(chosen))


def smallest_size(views: Sequence[View]) -> tuple[int, int]:
    """(width, height) of the training image with the shortest side, pixels."""
    return min(((view.camera.width, view.camera.height) for view in views), key=min)


def find_decisions(survey: Survey, device: Device | None = None, given: Sequence[Part] = ()) -> Decisions:
    """Decide about all that is optional; InputError where an option cannot be met. `given` are
    parts besides those that the options ask for; without a device, the option `engine` stays as it
    is."""
    scene, views, options, thumbnails = survey
    facts, schedule = scene_facts(scene, views, thumbnails), schedule_of(options.schedule)
    for part in given:
        facts = part.facts(facts, scene, views, None)
    steps, worthwhile, reason = worthwhile_steps(options, facts, len(views), is_stage(options, given))
    most = min(MOST_STEPS, max(1, round(worthwhile * options.steps_scale)))
    options = scaled_steps(replace(options, iterations=steps))
    survey = survey._replace(options=options)
    of_parts = {
        name: decision
        for part in (*PARTS, *map(registered_part, options.add_parts))
        for name, decision in part.decide(survey).items()
    }
    limit = Decision(*schedule.planned_limit(options, facts))
    compared = functools.cache(lambda: stereo_views(scene, views))
    start = Decision(*chosen_start(survey, compared))
    if start.value == "dense":
        # the gaussians of a coarse run are in another order than its points
        facts = replace(
            facts,
            dense=schedule.points_enter and not options.coarse,
            count=planned_count(limit.value, facts.pixels, options),
        )
    parts = {
        "steps": Decision(steps, reason),
        "init": start,
        "levels": Decision(*schedule.planned_levels(options, facts)),
        "gaussians": limit,
        "sh_degree": requested(options.sh_degree),
        **of_parts,
    }
    options = replace(options, **{name: parts[name].value for name in ("init", *of_parts)})
    if device is not None:
        device.limit_memory(bytes_of(options.memory_budget) if options.memory_budget else None)
        parts["engine"] = _engine(planned_initial(facts, options), options, device)
        options = replace(options, engine=parts["engine"].value)
    return Decisions(options, facts, most, parts, compared() if start.value == "dense" else None)


def is_stage(options: RunOptions, parts: Iterable[Part]) -> bool:
    """Whether a training is a stage of a larger one (`Part.is_stage`), such as a coarse run."""
    return options.coarse or any(part.is_stage for part in parts)


def _engine(facts: SceneFacts, options: ScheduledOptions, device: Device) -> Decision:
    """The Adam engine: with coded moments if the largest model would not fit well otherwise."""
    if options.engine != AUTO:
        return requested(options.engine)
    unseen = replace(facts, photos=lambda: iter(()))  # reading them would take long
    count = largest(simulate(schedule_of(options.schedule)(options, unseen)))
    available = device.memory_limit
    needed = {engine: model_bytes(device, options.sh_degree, count, engine) for engine in ("device", "coded")}
    value = "device" if needed["device"] < DEVICE_SHARE * available else "coded"
    return Decision(
        value,
        f"{value}: parameters and moments take up to "
        f"{needed['device'] / 2**20:,.0f} MiB, coded {needed['coded'] / 2**20:,.0f}, "
        f"of the device's {available / 2**20:,.0f}",
    )


def find_warnings(scene: Scene, thumbnails: Thumbnails, count: int) -> Iterator[str]:
    """Find what keeps a scene from becoming a good model, but stops no training: one sentence each.
    Thumbnails are of its training views; `count` is the number of initial gaussians."""
    yield from scene.notes
    if len(thumbnails.views) < FEW_PHOTOS:
        yield f"only {len(thumbnails.views)} training photos: 20 or more make a good model"
    if count < FEW_POINTS:
        yield (
            f"only {count} initial gaussians: growth has little to start from; reconstruct the scene with more points"
        )
    if not scene.parallax >= LEAST_PARALLAX:
        yield (
            "the photos were taken from one place (apart by no more than "
            f"{scene.parallax:.1g} of the points' distance): depth cannot be learned"
        )
    views, photos = thumbnails.sampled(SAMPLED_PHOTOS)
    points = scene.points[:: -(-len(scene.points) // SAMPLED_POINTS)]
    cover = np.mean([_covered(view.camera, points) for view in views])
    if cover < LEAST_COVER:
        yield (
            f"the sparse points cover {100 * cover:.0f} % of the photos: check that they belong "
            "to these cameras, and the units of both"
        )
    plain = [view.name for view, photo in zip(views, photos) if np.tensordot(LUMA, photo[:3], 1).std() < LEAST_CONTRAST]
    if plain:
        yield (
            f"{len(plain)} of {len(views)} sampled photos are of one colour, such as "
            f"{plain[0]}: nothing can be learned from them"
        )


def _covered(camera: Camera, points: NDArray[np.floating]) -> float:
    """The share of an image's cells that contain points."""
    pixels, depths = camera.project(points)
    cells = CELLS * pixels[depths > 0] / (camera.width, camera.height)
    cells = cells[((cells >= 0) & (cells < CELLS)).all(axis=1)].astype(int)
    return len(np.unique(cells @ (CELLS, 1))) / CELLS**2
