"""Decides before training which optional parts a scene needs, with the reasons."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from clsplat.config.option import AUTO, MOST_STEPS, is_auto
from clsplat.covisibility.exposure_drift import DRIFTS, exposure_drift
from clsplat.covisibility.source_views import ViewSpread, choose_source_views, view_spread
from clsplat.covisibility.vignetting import DARKENS, corner_darkening
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.options import TrainOptions
from clsplat.scene import Scene, View
from clsplat.schedule import (
    SceneFacts,
    planned_steps,
    scaled_steps,
    schedule_of,
    worthwhile_steps,
)
from clsplat.schedule.simulate import largest, simulate
from clsplat.stereo.dense_points import stereo_views
from clsplat.training.dense_start import chosen_start, planned_count
from clsplat.training.facts import scene_facts
from clsplat.training.initialise import planned_initial
from clsplat.training.model import DEVICE_SHARE, model_bytes
from clsplat.training.photos import decoded, with_side

SAMPLED_PHOTOS = 64
SMALL_SIDE = 256  # pixels; brightness needs no more
HIGHEST_DEGREE = 3
SHINE = 0.1  # amplitude of view-dependent colour, as a share of full brightness
VISIBLE = 1 / 255  # of full brightness: a step of 8 bits
SERVED_SHARE = 0.99  # of the points for which a degree must suffice


@dataclasses.dataclass(frozen=True)
class Decision:
    """The decision about one optional part.

    Attributes
    ----------
    value : what is used.
    reason : sentence that begins with the value and gives the number behind it.
    requested : whether an option decided instead of the scene.
    """

    value: Any
    reason: str
    requested: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Decisions:
    """All decisions about a training before it begins.

    Attributes
    ----------
    options : with values instead of "auto" where the scene decides, and with scaled steps.
    neighbours : indices of the source views of each training view; None if no loss term uses them.
    facts : what the schedule knows about the scene, with the planned number of initial gaussians.
    most_steps : which a time budget may not exceed.
    parts : name of a part -> its decision.
    compared : `stereo_views` of the training views, where training begins at dense points.
    """

    options: TrainOptions
    neighbours: list[list[int]] | None
    facts: SceneFacts
    most_steps: int
    parts: dict[str, Decision]
    compared: list[list[int]] | None = None

    @property
    def reasons(self) -> dict[str, str]:
        """Name of a part -> sentence."""
        return {name: part.reason for name, part in self.parts.items()}

    @property
    def values(self) -> dict[str, Any]:
        """Name of a part -> what is used, for the record; the options have what was requested."""
        return {name: part.value for name, part in self.parts.items()}


def find_decisions(scene: Scene, views: Sequence[View], options: TrainOptions,
                   device: Device | None = None) -> Decisions:
    """Decide about all optional parts; InputError where an option cannot be met.

    Parameters
    ----------
    scene : at the size of training.
    views : the training views of the scene.
    options : as the user gave them.
    device : of the training; None leaves the choice of the Adam engine to `model.Model`, which
        knows the initial gaussians only.
    """
    facts, schedule = scene_facts(scene, views), schedule_of(options.schedule)
    length, most = _steps(scene, len(views), options, facts)
    options = scaled_steps(dataclasses.replace(options, iterations=length.value))
    exposure = _exposure(scene, views, options)
    neighbours, reproject = _neighbours(scene, views, options)
    spread = view_spread(scene, scene.views)  # held-out views must be served, too
    limit = Decision(*schedule.planned_limit(options, facts))
    compared = functools.cache(lambda: stereo_views(scene, views))
    start = Decision(*chosen_start(scene, views, options, compared))
    if start.value == "dense":
        facts = dataclasses.replace(facts, count=planned_count(limit.value, facts.pixels, options))
    parts = {"steps": length, "init": start,
             "levels": Decision(*schedule.planned_levels(options, facts)), "gaussians": limit,
             "sh_degree": _degree(spread, options), "antialiased": _antialiased(spread, options),
             "exposure": exposure, "vignetting": _vignetting(scene, views, options, exposure),
             "robust": _robust(options), "reproject": reproject}
    decided = ("init", "sh_degree", "exposure", "vignetting", "reproject")
    options = dataclasses.replace(options, **{name: parts[name].value for name in decided})
    if device is not None:
        parts["engine"] = _engine(planned_initial(facts, options), options, device)
        options = dataclasses.replace(options, engine=parts["engine"].value)
    return Decisions(options, neighbours, facts, most, parts,
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


def is_part_of_city(scene: Scene, options: TrainOptions) -> bool:
    """Whether this is the training of a coarse run, a block or the merged model, which the city's
    report shows."""
    return options.coarse or scene.exposures is not None or scene.region is not None


def _steps(scene: Scene, photos: int, options: TrainOptions, facts: SceneFacts
           ) -> tuple[Decision, int]:
    """(The number of steps before `steps_scale`, the most with it). Parts of a city take as many as
    they are told."""
    if is_part_of_city(scene, options):  # their photos need not be compared
        return Decision(*planned_steps(options, photos)), MOST_STEPS
    steps, most, reason = worthwhile_steps(options, facts, photos)
    scaled = max(1, round(most * options.steps_scale)) if most else MOST_STEPS
    return Decision(steps, reason), min(MOST_STEPS, scaled)


def _requested(value: Any) -> Decision:
    return Decision(value, f"{value}: requested", requested=True)


def _degree(spread: ViewSpread, options: TrainOptions) -> Decision:
    """The degree of the spherical harmonics."""
    if options.sh_degree == HIGHEST_DEGREE:
        return Decision(HIGHEST_DEGREE, f"{HIGHEST_DEGREE}: all, the default")
    if not is_auto(options.sh_degree):
        return _requested(options.sh_degree)
    if not len(spread.cap):
        return Decision(HIGHEST_DEGREE, f"{HIGHEST_DEGREE}: no point is seen by two views, so "
                        "the viewing angles are unknown")
    cap = float(np.quantile(spread.cap, SERVED_SHARE))
    degree = needed_degree(cap)
    return Decision(degree, f"{degree}: {SERVED_SHARE:.0%} of the points are seen from within "
                    f"{cap:.1f} degrees of their mean direction")


def _antialiased(spread: ViewSpread, options: TrainOptions) -> Decision:
    """On only if requested; the reason gives the range of scales, on which its benefit depends."""
    value = "on" if options.antialiased else "off"
    ratios = spread.ratio[np.isfinite(spread.ratio)]
    seen = (f"; nine points in ten are seen at scales within a factor of "
            f"{np.quantile(ratios, 0.9):.1f}" if len(ratios) else "")
    return Decision(value, f"{value}: {'' if options.antialiased else 'not '}requested{seen}",
                    requested=options.antialiased)


def _exposure(scene: Scene, views: Sequence[View], options: TrainOptions) -> Decision:
    if options.exposure != AUTO:
        return _requested(options.exposure)
    small = _small_photos(views)
    drift = exposure_drift(small, decoded(small), scene.points, scene.colours)
    value = "on" if drift >= DRIFTS else "off"
    return Decision(value, f"{value}: the brightness of {len(small)} photos varies by "
                    f"{100 * drift:.1f} % ({100 * DRIFTS:.1f} % counts as drift)")


def _vignetting(scene: Scene, views: Sequence[View], options: TrainOptions, exposure: Decision
                ) -> Decision:
    """On only with exposures, with which it is learned."""
    if exposure.value == "off" or options.vignetting != AUTO:
        return _with_exposures("vignetting", options.vignetting, exposure)
    small = _small_photos(views)
    darker = corner_darkening(small, decoded(small), scene.points)
    value = "on" if darker >= DARKENS else "off"
    return Decision(value, f"{value}: the corners of {len(small)} photos are {100 * darker:.1f} % "
                    f"darker than their middle ({100 * DARKENS:.1f} % counts as vignetting)")


def _with_exposures(name: str, value: str, exposure: Decision) -> Decision:
    """The decision about a part of responses that is asked for, or is not."""
    if exposure.value == "off":
        if value == "on":
            raise InputError(f"--{name} on: is learned with exposures only; add --exposure on")
        return Decision("off", "off: exposures are not learned")
    return Decision("off", "off: not requested") if value == "off" else _requested(value)


def _robust(options: TrainOptions) -> Decision:
    """On only if requested; the run finds what is left out, and records how much."""
    if options.robust == "on":
        return Decision("on", "on: requested; the record `robust` of the run has the share of the "
                        "pixels that are left out", requested=True)
    return Decision("off", "off: not requested")


def _small_photos(views: Sequence[View]) -> tuple[View, ...]:
    """Some of the views, with small photos."""
    return with_side(views[::-(-len(views) // SAMPLED_PHOTOS)], SMALL_SIDE)


def _neighbours(scene: Scene, views: Sequence[View], options: TrainOptions
                ) -> tuple[list[list[int]] | None, Decision]:
    """(`Decisions.neighbours`, the decision about the reprojection loss)."""
    if options.reproject == "off" or not options.reproject_weight:
        return None, Decision("off", "off: not requested")
    neighbours: list[list[int]] = [
        adjacent.tolist() for adjacent in choose_source_views(scene, views)]
    paired = sum(len(adjacent) > 0 for adjacent in neighbours)
    if paired:
        return neighbours, Decision("on", f"on: {paired} of {len(views)} photos have an adjacent "
                                    "one", requested=options.reproject == "on")
    if options.reproject == "on":
        raise InputError(f"{scene.name}: --reproject on needs two photos that share 20 sparse "
                         "points; there are none: use --reproject auto or off")
    return None, Decision("off", "off: no two photos share 20 sparse points")


def _engine(facts: SceneFacts, options: TrainOptions, device: Device) -> Decision:
    """The Adam engine: on the device if the largest model fits."""
    if options.engine != AUTO:
        return _requested(options.engine)
    unseen = dataclasses.replace(facts, photos=lambda: iter(()))  # reading them would take long
    count = largest(simulate(schedule_of(options.schedule)(options, unseen)))
    needed = model_bytes(device, options.sh_degree, count)
    available = device.handle.global_mem_size
    value = "device" if needed < DEVICE_SHARE * available else "numpy"
    return Decision(value, f"{value}: parameters and moments take up to {needed / 2**20:,.0f} MiB "
                    f"of the device's {available / 2**20:,.0f}")
