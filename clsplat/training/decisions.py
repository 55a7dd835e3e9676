"""What of the optional parts this scene needs, decided before training, with the reasons."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from clsplat.config.option import AUTO
from clsplat.covisibility.exposure_drift import DRIFTS, exposure_drift
from clsplat.covisibility.source_views import choose_source_views, view_spread
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED
from clsplat.options import TrainOptions
from clsplat.scene import Scene, View
from clsplat.schedule import SceneFacts, schedule_of
from clsplat.schedule.simulate import largest, simulate
from clsplat.training.model import DEVICE_SHARE, GROWTH_ROOM
from clsplat.training.photos import at_level, decoded

SAMPLED_PHOTOS = 64  # photos that stand for all
SMALL_SIDE = 256  # pixels; brightness needs no more
HIGHEST_DEGREE = 3
SHINE = 0.1  # amplitude of what depends on the direction, of full brightness
VISIBLE = 1 / 255  # of full brightness: a step of 8 bits
SHARE = 0.99  # of the points that a degree must serve


@dataclasses.dataclass(frozen=True)
class Decision:
    """What is used of a part that is optional.

    Attributes
    ----------
    value : what is used.
    reason : a sentence that begins with it, and has the number behind it.
    asked : whether an option overrode what would have been found.
    """

    value: Any
    reason: str
    asked: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Decisions:
    """What is decided of a training before it begins.

    Attributes
    ----------
    options : with values in place of "auto" where the scene decides.
    neighbours : of each training view, the indices of its source views; None where no loss term
        compares with them.
    parts : name of a part -> its Decision.
    """

    options: TrainOptions
    neighbours: list[list[int]] | None
    parts: dict[str, Decision]

    @property
    def reasons(self) -> dict[str, str]:
        """Name of a part -> sentence."""
        return {name: part.reason for name, part in self.parts.items()}

    @property
    def values(self) -> dict[str, Any]:
        """Name of a part -> what is used, for the record; the options have what was asked for."""
        return {name: part.value for name, part in self.parts.items()}


def find_decisions(scene: Scene, views: Sequence[View], options: TrainOptions,
                   device: Device | None = None) -> Decisions:
    """Decide what is optional; InputError where an option cannot be met.

    Parameters
    ----------
    scene : at the size of training.
    views : those of it that are trained on.
    options : with scaled steps.
    device : that of the training. Without it, where moments are kept is left to `model.Model`,
        which knows the initial gaussians only.
    """
    exposure = _exposure(scene, views, options)
    neighbours, reproject = _neighbours(scene, views, options)
    spread = view_spread(scene, scene.views)  # of all views: held-out ones are to be met, too
    parts = {"levels": _levels(views, options), "sh_degree": _degree(spread, options),
             "antialiased": _antialiased(spread, options), "exposure": exposure,
             "reproject": reproject}
    decided = ("sh_degree", "exposure", "reproject")
    options = dataclasses.replace(options, **{name: parts[name].value for name in decided})
    if device is not None:
        parts["engine"] = _engine(scene, views, options, device)
        options = dataclasses.replace(options, engine=parts["engine"].value)
    return Decisions(options, neighbours, parts)


def needed_degree(cap: float) -> int:
    """The lowest degree of spherical harmonics with which colours seen from within `cap` degrees of
    a middle direction are right to a step of 8 bits.

    A colour that harmonics up to L describe changes by at most L^k times its amplitude in k
    derivatives (Bernstein's inequality), so what its Taylor polynomial of degree n leaves over, a
    cap's radius r away, is at most amplitude (L r)^(n + 1) / (n + 1)!; harmonics of degree n hold
    that polynomial. L is 3, the amplitude a tenth of full brightness: 0.7, 5.3 and 11.8 degrees are
    the limits of 0, 1 and 2.
    """
    reach = HIGHEST_DEGREE * math.radians(cap)
    for degree in range(HIGHEST_DEGREE):
        if SHINE * reach ** (degree + 1) / math.factorial(degree + 1) <= VISIBLE:
            return degree
    return HIGHEST_DEGREE


def _asked(value):
    return Decision(value, f"{value}: asked for", asked=True)


def _levels(views, options):
    """Those that the schedule will take."""
    return Decision(*schedule_of(options.schedule).planned_levels(options, smallest_size(views)))


def _degree(spread, options):
    """Of the harmonics."""
    if options.sh_degree == HIGHEST_DEGREE:
        return Decision(HIGHEST_DEGREE, f"{HIGHEST_DEGREE}: all, the default")
    if options.sh_degree != AUTO:
        return _asked(options.sh_degree)
    if not len(spread.cap):
        return Decision(HIGHEST_DEGREE, f"{HIGHEST_DEGREE}: no point is seen by two views, nothing "
                        "is known of angles")
    cap = float(np.quantile(spread.cap, SHARE))
    degree = needed_degree(cap)
    return Decision(degree, f"{degree}: {SHARE:.0%} of the points are seen from within {cap:.1f} "
                    "degrees of their mean direction")


def _antialiased(spread, options):
    """Nothing decides it: it is on where asked for. The number is what it has to do with."""
    value = "on" if options.antialiased else "off"
    ratios = spread.ratio[np.isfinite(spread.ratio)]
    seen = (f"; nine points in ten are seen at scales within a factor of "
            f"{np.quantile(ratios, 0.9):.1f}" if len(ratios) else "")
    return Decision(value, f"{value}: {'' if options.antialiased else 'not '}asked for{seen}",
                    asked=options.antialiased)


def _exposure(scene, views, options):
    if options.exposure != AUTO:
        return _asked(options.exposure)
    chosen = views[::-(-len(views) // SAMPLED_PHOTOS)]
    side = max(max(v.camera.width, v.camera.height) for v in chosen)
    small = at_level(chosen, max(1.0, side / SMALL_SIDE))
    drift = exposure_drift(small, decoded(small), scene.points, scene.colours)
    value = "on" if drift >= DRIFTS else "off"
    return Decision(value, f"{value}: the brightness of {len(chosen)} photos varies by "
                    f"{100 * drift:.1f} % ({100 * DRIFTS:.1f} % counts as drift)")


def _neighbours(scene, views, options):
    """(indices of adjacent views by view or None, Decision)."""
    if options.reproject == "off" or not options.reproject_weight:
        return None, Decision("off", "off: not asked for")
    found = choose_source_views(scene, views)
    paired = sum(len(adjacent) > 0 for adjacent in found)
    if paired:
        return found, Decision("on", f"on: {paired} of {len(views)} photos have an adjacent one",
                               asked=options.reproject == "on")
    if options.reproject == "on":
        raise InputError(f"{scene.name}: --reproject on needs two photos that share 20 sparse "
                         "points; there are none: use --reproject auto or off")
    return None, Decision("off", "off: no two photos share 20 sparse points")


def _engine(scene, views, options, device):
    """Where the moments are kept: by the most gaussians there will be, and room to grow."""
    if options.engine != AUTO:
        return _asked(options.engine)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    facts = SceneFacts(smallest_size(views), len(scene.points), 1.0, tuple, pixels)
    count = largest(simulate(schedule_of(options.schedule)(options, facts)))
    floats = sum(field.width(options.sh_degree) for field in LEARNED)
    needed = 3 * floats * GROWTH_ROOM * count * device.real.itemsize
    there = device.handle.global_mem_size
    value = "device" if needed < DEVICE_SHARE * there else "numpy"
    return Decision(value, f"{value}: parameters and moments take up to {needed / 2**20:,.0f} MiB "
                    f"of the device's {there / 2**20:,.0f}")


def smallest_size(views: Sequence[View]) -> tuple[int, int]:
    """(width, height) of the training image with the shortest side, pixels."""
    sizes = [(view.camera.width, view.camera.height) for view in views]
    return sizes[int(np.argmin([min(size) for size in sizes]))]
