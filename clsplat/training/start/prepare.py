"""From a scene as it was read to one that is ready for training, with all decisions made."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clsplat.config.option import AUTO, MOST_STEPS, is_auto
from clsplat.covisibility.photometry import colour_disagreement
from clsplat.covisibility.source_views import ViewSpread, photos_of_a_point, view_spread
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, mean_inverse_distance
from clsplat.io.photos.depth import with_depths
from clsplat.options import RunOptions, ScheduledOptions, TrainOptions
from clsplat.rendering.options import RenderingOptions
from clsplat.scene import Scene, View
from clsplat.schedule import (
    SceneFacts,
    Schedule,
    planned_steps,
    scaled_steps,
    schedule_of,
    worthwhile_steps,
)
from clsplat.schedule.simulate import largest, simulate
from clsplat.stereo.dense_points import stereo_views
from clsplat.training.model import DEVICE_SHARE, model_bytes
from clsplat.training.part import Decision, Part, Survey, requested
from clsplat.training.parts import PARTS, registered_part
from clsplat.training.photos import Thumbnails, decoded
from clsplat.training.start.initialise import chosen_start, planned_count, planned_initial

RUNS, RUN = 4, 12  # of photos that follow each other, and so show the same places
HIGHEST_DEGREE = 3
SHINE = 0.1  # amplitude of view-dependent colour, as a share of full brightness
VISIBLE = 1 / 255  # of full brightness: a step of 8 bits
SERVED_SHARE = 0.99  # of the points for which a degree must suffice


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

    def schedule(self, gaussians: Gaussians, options: ScheduledOptions | None = None) -> Schedule:
        """A new schedule for these initial gaussians; `options` replace those of the scene."""
        options = options or self.options
        facts = replace(self.decisions.facts, count=gaussians.count)
        for part in self.given:
            facts = part.facts(facts, self.scene, self.train_views, gaussians)
        return schedule_of(options.schedule)(options, facts)


def prepare(scene: Scene, options: TrainOptions, device: Device | None = None,
            parts: Iterable[Part] = ()) -> PreparedScene:
    """Prepare a scene for training, with options as they were given, and with `parts` besides those
    that they ask for; InputError where that is impossible."""
    parts = tuple(parts)
    scene = with_depths(scene, options.depth)
    scene = scene.reduced(options.downscale, options.max_resolution).normalised()
    if len(scene.views) < 2:
        raise InputError(f"{scene.name}: has a single photo; depth needs at least two from "
                         "different places, and 20 or more make a good model")
    train_views, test_views = scene.split(options.test_every, options.test_offset)
    if options.robust == "on":
        train_views = tuple(replace(view, weighed=True) for view in train_views)
    if not train_views:
        raise InputError(f"{scene.name}: --test-every {options.test_every} holds out every "
                         "view; use a larger number, or none")
    if options.test_offset and not test_views:
        raise InputError(f"{scene.name}: --test-offset {options.test_offset} holds out none of its "
                         f"{len(scene.views)} views; use a smaller number")
    thumbnails = Thumbnails(train_views)
    return PreparedScene(scene, train_views, test_views, find_decisions(
        scene, train_views, options, device, thumbnails, parts), thumbnails, parts)


def scene_facts(scene: Scene, views: Sequence[View], thumbnails: Thumbnails | None = None
                ) -> SceneFacts:
    """The facts of a scene for its schedule, if gaussians begin at its sparse points; `views` are
    its training views, at the size of training, and `thumbnails` of these."""
    return SceneFacts(
        smallest_size(views), len(scene.points), mean_inverse_distance(scene.points) / scene.unit,
        lambda: (photo[:3] for photo in decoded(views)),
        sum(view.camera.width * view.camera.height for view in views),
        functools.cache(functools.partial(_disagreement, scene, thumbnails or Thumbnails(views))),
        photos_of_a_point(scene, views))


def _disagreement(scene: Scene, thumbnails: Thumbnails) -> float:
    """The disagreement of some of the photos."""
    count = len(thumbnails.views)
    chosen = range(count) if count <= RUNS * RUN else [
        begin * (count - RUN) // (RUNS - 1) + number
        for begin in range(RUNS) for number in range(RUN)]
    return colour_disagreement(scene, *thumbnails.of(chosen))


def smallest_size(views: Sequence[View]) -> tuple[int, int]:
    """(width, height) of the training image with the shortest side, pixels."""
    return min(((view.camera.width, view.camera.height) for view in views), key=min)


def find_decisions(scene: Scene, views: Sequence[View], options: TrainOptions,
                   device: Device | None = None, thumbnails: Thumbnails | None = None,
                   given: Sequence[Part] = ()) -> Decisions:
    """Decide about all that is optional; InputError where an option cannot be met.

    Parameters
    ----------
    scene : the scene at the size of training.
    views : its training views.
    options : the options as the user gave them.
    device : where it trains; None leaves the choice of the Adam engine to `model.Model`, by the
        number of initial gaussians.
    thumbnails : small photos of the views.
    given : parts besides those that the options ask for.
    """
    thumbnails = thumbnails or Thumbnails(views)
    facts, schedule = scene_facts(scene, views, thumbnails), schedule_of(options.schedule)
    for part in given:
        facts = part.facts(facts, scene, views, None)
    length, most = _steps(len(views), options, facts, is_stage(options, given))
    options = scaled_steps(replace(options, iterations=length.value))
    survey = Survey(scene, views, options, thumbnails)
    of_parts = {name: decision for part in (*PARTS, *map(registered_part, options.add_parts))
                for name, decision in part.decide(survey).items()}
    spread = view_spread(scene, scene.views)  # held-out views must be served, too
    limit = Decision(*schedule.planned_limit(options, facts))
    compared = functools.cache(lambda: stereo_views(scene, views))
    start = Decision(*chosen_start(scene, views, options, compared))
    if start.value == "dense":
        facts = replace(facts, count=planned_count(limit.value, facts.pixels, options))
    parts = {"steps": length, "init": start,
             "levels": Decision(*schedule.planned_levels(options, facts)), "gaussians": limit,
             "sh_degree": _degree(spread, options), "antialiased": _antialiased(spread, options),
             **of_parts}
    decided = ("init", "sh_degree", *of_parts)
    options = replace(options, **{name: parts[name].value for name in decided})
    if device is not None:
        parts["engine"] = _engine(planned_initial(facts, options), options, device)
        options = replace(options, engine=parts["engine"].value)
    return Decisions(options, facts, most, parts,
                     compared() if start.value == "dense" else None)


def needed_degree(cap: float) -> int:
    """The lowest degree of spherical harmonics that is exact to a step of 8 bits within a cone.

    The k-th derivative of a colour in spherical harmonics up to degree L is at most L^k times its
    amplitude (Bernstein's inequality), so the remainder of its Taylor polynomial of degree n at the
    cone's radius r is at most amplitude (L r)^(n + 1) / (n + 1)!, and harmonics of degree n contain
    that polynomial. With L = 3 and a tenth of full brightness as amplitude, the limits of degrees
    0, 1 and 2 are 0.7, 5.3 and 11.8 degrees.

    Parameters
    ----------
    cap : half angle of the cone of viewing directions, degrees.
    """
    reach = HIGHEST_DEGREE * math.radians(cap)
    for degree in range(HIGHEST_DEGREE):
        if SHINE * reach ** (degree + 1) / math.factorial(degree + 1) <= VISIBLE:
            return degree
    return HIGHEST_DEGREE


def is_stage(options: RunOptions, parts: Iterable[Part]) -> bool:
    """Whether a training is a stage of a larger one (`Part.is_stage`), such as a coarse run."""
    return options.coarse or any(part.is_stage for part in parts)


def _steps(photos: int, options: ScheduledOptions, facts: SceneFacts, stage: bool
           ) -> tuple[Decision, int]:
    """(The number of steps before `steps_scale`, the most with it). A stage takes as many as its
    options say."""
    if stage:  # its photos need not be compared
        return Decision(*planned_steps(options, photos)), MOST_STEPS
    steps, most, reason = worthwhile_steps(options, facts, photos)
    scaled = max(1, round(most * options.steps_scale)) if most else MOST_STEPS
    return Decision(steps, reason), min(MOST_STEPS, scaled)


def _degree(spread: ViewSpread, options: RenderingOptions) -> Decision:
    """The degree of the spherical harmonics."""
    if options.sh_degree == HIGHEST_DEGREE:
        return Decision(HIGHEST_DEGREE, f"{HIGHEST_DEGREE}: all, the default")
    if not is_auto(options.sh_degree):
        return requested(options.sh_degree)
    if not len(spread.cap):
        return Decision(HIGHEST_DEGREE, f"{HIGHEST_DEGREE}: no point is seen by two views, so "
                        "the viewing angles are unknown")
    cap = float(np.quantile(spread.cap, SERVED_SHARE))
    degree = needed_degree(cap)
    return Decision(degree, f"{degree}: {SERVED_SHARE:.0%} of the points are seen from within "
                    f"{cap:.1f} degrees of their mean direction")


def _antialiased(spread: ViewSpread, options: RenderingOptions) -> Decision:
    """On only if requested; the reason gives the range of scales, on which its benefit depends."""
    value = "on" if options.antialiased else "off"
    ratios = spread.ratio[np.isfinite(spread.ratio)]
    seen = (f"; nine points in ten are seen at scales within a factor of "
            f"{np.quantile(ratios, 0.9):.1f}" if len(ratios) else "")
    return Decision(value, f"{value}: {'' if options.antialiased else 'not '}requested{seen}",
                    requested=options.antialiased)


def _engine(facts: SceneFacts, options: ScheduledOptions, device: Device) -> Decision:
    """The Adam engine: on the device if the largest model fits."""
    if options.engine != AUTO:
        return requested(options.engine)
    unseen = replace(facts, photos=lambda: iter(()))  # reading them would take long
    count = largest(simulate(schedule_of(options.schedule)(options, unseen)))
    needed = model_bytes(device, options.sh_degree, count)
    available = device.handle.global_mem_size
    value = "device" if needed < DEVICE_SHARE * available else "numpy"
    return Decision(value, f"{value}: parameters and moments take up to {needed / 2**20:,.0f} MiB "
                    f"of the device's {available / 2**20:,.0f}")
